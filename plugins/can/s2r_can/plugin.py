"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

LOGS = {
    "log": ("candump", "candump"),
    "asc": ("Vector ASC", "asc"),
    "blf": ("Vector BLF", "blf"),
    "trc": ("PCAN TRC", "trc"),
    "csv": ("python-can CSV", "csv"),
    "savvycan": ("SavvyCAN CSV", "savvycan"),
    "db": ("python-can SQLite", "sqlite"),
}
"""Suffix -> (what it is, its recogniser in `kinds`)."""


@hookimpl
def s2r_transports() -> list[Offer]:
    """The CAN transport."""
    what = "robots on a CAN bus, described by its DBC"
    return [Offer("can", "s2r_can.transport:CanTransport", what, files=("dbc",), normal_form="s2r_can.database:stated")]


@hookimpl
def s2r_recordings() -> list[Offer]:
    """Logs of a CAN bus."""
    return [
        Offer(f"can.{suffix}", "s2r_can.recordings:read", f"{name} logs of a bus, by its DBC", recognises=f"s2r_can.kinds:is_{kind}")
        for suffix, (name, kind) in LOGS.items()
    ]


@hookimpl
def s2r_formats() -> list[Offer]:
    """The same logs, for whom their signals are named."""
    return [
        Offer(f"can.{suffix}", "s2r_can.signals:open_log", f"{name} log of a CAN bus", files=("dbc",)) for suffix, (name, _) in LOGS.items()
    ]


@hookimpl
def s2r_kits() -> list[Offer]:
    """How the transport is tried."""
    return [
        Offer("transports.can", "s2r_can.kits:WideKit"),
        Offer("transports.can.classic", "s2r_can.kits:ClassicKit"),
    ]
