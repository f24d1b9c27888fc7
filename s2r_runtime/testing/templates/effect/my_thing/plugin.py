"""What this package offers: nothing is imported before it is used."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

S2R_API_VERSION = 1


@hookimpl
def s2r_effects() -> list[Offer]:
    """The tracer tries it from now on, and models name it: [[model.effects]] name = "my_thing"."""
    return [Offer("my_thing", "my_thing.effect:EFFECT", "an input's response is bent")]


@hookimpl
def s2r_kits() -> list[Offer]:
    """For `s2r plugin check my_thing`."""
    return [Offer("effects.my_thing", "my_thing.testing:MyThingKit")]
