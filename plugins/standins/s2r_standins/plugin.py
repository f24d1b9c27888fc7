"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_robots() -> list[Offer]:
    """Robots for the demo and for tests."""
    return [
        Offer("robotarium", "s2r_standins.robotarium:ROBOT", "the Robotarium's robot over Zenoh"),
        Offer("quadruped", "s2r_standins.quadruped:ROBOT", "a walking quadruped in rigid-body physics, over Zenoh (extra: sim)"),
    ]
