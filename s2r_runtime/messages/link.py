"""What a link to a robot carries: bytes, observations, commands, and how far the log is on the disk. And the base of all messages."""

from __future__ import annotations

from typing import Literal

import msgspec

Source = Literal["controller", "sampler", "recovery", "external"]
"""Who proposes a command. An outsider that commands unasked is `external`, and is never allowed."""


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all that is logged; `tag` is the channel's last word."""


class Frame(Struct, frozen=True, tag="frame"):
    """Bytes as a transport received (`inbound`) or sent them. `arrival_ns`: host monotonic clock."""

    arrival_ns: int
    channel: str
    data: bytes
    inbound: bool = True


class Observation(Struct, frozen=True, tag="observation"):
    """Measured model state. x: (nx,) in the model's order; `stamp_ns`: the robot's own monotonic clock.

    `fault` is not empty iff the observation cannot be used (then x may be empty): what was wrong with it, in a few words.
    """

    seq: int
    stamp_ns: int
    x: tuple[float, ...]
    fault: str = ""


class Command(Struct, frozen=True, tag="command"):
    """An input that somebody asks the robot to apply. u: (nu,); answers the observation `obs_seq`; void after `ttl_ns`."""

    seq: int
    t_ns: int
    source: Source
    u: tuple[float, ...]
    obs_seq: int
    ttl_ns: int
    fault: str = ""


class Scenarios(Struct, frozen=True):
    """Scenarios `first` to `first + count - 1` of this seed, for a comparison: a deployment drives them and ends."""

    seed: int
    first: int
    count: int


class LogHead(Struct, frozen=True, tag="log_head"):
    """Not logged, but told to whoever keeps it: so far the log of this run is on the disk (docs/log-format.md). head, public_key: hex."""

    run: str
    part: int
    records: int
    head: str
    public_key: str
