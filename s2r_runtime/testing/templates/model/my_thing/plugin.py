"""What this package offers: nothing is imported before it is used."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

S2R_API_VERSION = 1


@hookimpl
def s2r_models() -> list[Offer]:
    """Profiles name it: [model] name = "my_thing"."""
    return [Offer("my_thing", "my_thing.model:MODEL", "a cart on a rail that a force pushes")]


@hookimpl
def s2r_kits() -> list[Offer]:
    """For `s2r plugin check my_thing`."""
    return [Offer("models.my_thing", "my_thing.testing:MyThingKit")]
