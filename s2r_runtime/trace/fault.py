"""A fault of measurement, and from where on something is one."""

from __future__ import annotations

from dataclasses import dataclass

SIGMAS = 8.0
"""Robust standard deviations from which a single residual is suspected."""

FROZEN_ROWS = 5
"""Rows that repeat a state exactly before it counts as frozen."""

QUANTA = 6.0
"""Least changes by which a state must have moved on while it repeated: below that it may be resolution."""


@dataclass(frozen=True)
class Fault:
    """An interval of the recording, s since its first stamp. channel: a state, or `*`. kind: as docs/json.md."""

    from_s: float
    to_s: float
    channel: str
    kind: str
