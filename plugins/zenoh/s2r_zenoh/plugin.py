"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The Zenoh transport."""
    return [Offer("zenoh", "s2r_zenoh.transport:ZenohTransport", "robots that speak Zenoh, with or without a router")]


@hookimpl
def s2r_kits() -> list[Offer]:
    """How the transport is tried."""
    return [
        Offer("transports.zenoh", "s2r_zenoh.kits:PeerKit"),
        Offer("transports.zenoh.client", "s2r_zenoh.kits:ClientKit"),
    ]
