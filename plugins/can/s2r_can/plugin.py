"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The CAN transport."""
    return [Offer("can", "s2r_can.transport:CanTransport", "robots on a CAN bus, described by its DBC", files=("dbc",))]
