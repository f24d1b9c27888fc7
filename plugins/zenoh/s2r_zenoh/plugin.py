"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The Zenoh transport."""
    return [Offer("zenoh", "s2r_zenoh.transport:ZenohTransport", "robots that speak Zenoh, with or without a router")]
