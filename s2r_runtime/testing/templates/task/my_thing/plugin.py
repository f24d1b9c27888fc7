"""What this package offers: nothing is imported before it is used."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

S2R_API_VERSION = 1


@hookimpl
def s2r_tasks() -> list[Offer]:
    """Profiles name it: [task] name = "my_thing"."""
    return [Offer("my_thing", "my_thing.task:MyThing", "down a corridor without touching its walls")]


@hookimpl
def s2r_kits() -> list[Offer]:
    """For `s2r plugin check my_thing`."""
    return [Offer("tasks.my_thing", "my_thing.testing:MyThingKit")]
