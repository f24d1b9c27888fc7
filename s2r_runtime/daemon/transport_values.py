"""What a transport gives is what its interface says (hookspecs.Transport), or it is refused: one TypeError that says what came instead.

A plug-in is somebody else's code. What it gives is logged, hashed, compared and decided on, and none of that may meet a value that isn't
of its type, not finite, or stamped with a time that has not come yet: an arrival in the future would keep an observation fresh for ever.
The audit asks the same of what it decodes again.

A stop is never refused for the company that it came in: whatever else a frame says, however long the stop's text is, `decoded` gives it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeGuard, cast, get_args, get_type_hints

from s2r_runtime.hookspecs import Transport
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

Inbound = Observation | Command | LinkChanged | OverrideChanged | ObservationRefused

DROPPED = "transport: receive "
"""How the text of the stop begins that the daemon takes dropped input for."""
FRAMES_AT_ONCE = 4096
"""Ten times what the transports here keep at most for a loop that is late; deciding on so many takes a good part of a second."""
MESSAGES_A_FRAME = 256
BYTES, TEXT, COMPONENTS = 1 << 20, 1000, 256
EARLY_NS = 1_000_000
"""By which an arrival may be ahead of the clock: frames of one instant are told apart by nanoseconds."""
LINES, LINE_COUNTERS = 20, 200
KINDS = frozenset(get_args(get_type_hints(OverrideChanged)["kind"]))
"""Of overrides."""


class Flood(Exception):
    """More came at once than a bounded queue can hold."""


def frames(given: object, now_ns: int) -> list[Frame]:
    """What `receive` gave. now_ns: the host's monotonic clock. Raises TypeError or Flood."""
    if not isinstance(given, list):
        raise TypeError(f"gave {_kind(given)}, must be a list of Frame")
    if len(given) > FRAMES_AT_ONCE:
        raise Flood(f"gave {len(given)} frames at once, at most {FRAMES_AT_ONCE} are taken")
    for frame in given:
        _frame(frame)
        if not frame.inbound:
            raise TypeError("gave a frame that is not inbound")
        if not 0 <= frame.arrival_ns <= now_ns + EARLY_NS:
            raise TypeError(
                f"gave a frame with arrival_ns {frame.arrival_ns}, must be the host's monotonic clock, not after now ({now_ns})"
            )
    return given


class Decoded(NamedTuple):
    """What a frame says. fault: why all of it but the overrides was refused, one of each kind at most; or None."""

    messages: list[Inbound]
    fault: Exception | None


def decoded(transport: Transport, frame: Frame, nx: int) -> Decoded:
    """What the transport makes of a frame. Raises what the transport raises."""
    given: object = transport.decode(frame)
    try:
        if not isinstance(given, list) or len(given) > MESSAGES_A_FRAME:
            raise TypeError(f"gave {_kind(given)}, must be a list of at most {MESSAGES_A_FRAME} messages")
        messages = [_override(message) or message for message in given]
        for message in messages:
            _message(message, nx)
    except Exception as fault:  # noqa: BLE001 - somebody else's values may raise anything when they are looked at
        said = cast("list[object]", given) if isinstance(given, list | tuple) else [given]
        stops = {stop.kind: stop for stop in map(_override, said) if stop is not None}
        return Decoded(list(stops.values()), fault)
    return Decoded(messages, None)


def link_changes(given: object) -> list[LinkChanged]:
    """What `poll` gave. Raises TypeError."""
    if not isinstance(given, list) or len(given) > MESSAGES_A_FRAME:
        raise TypeError(f"gave {_kind(given)}, must be a list of LinkChanged")
    for change in given:
        if type(change) is not LinkChanged:
            raise TypeError(f"gave {_kind(change)}, must be LinkChanged")
        _message(change, 0)
    return given


def outbound(given: object) -> Frame:
    """What `encode` gave. Raises TypeError."""
    frame = _frame(given)
    if frame.inbound:
        raise TypeError("gave an inbound frame, must be inbound=False")
    return frame


def descriptor(given: object) -> int:
    """What `fileno` gave. Raises TypeError."""
    if not _whole(given) or given < 0:
        raise TypeError(f"gave {given!r}, must be an open descriptor")
    return given


def lines(given: object) -> list[str]:
    """What `lines` gave, as far as it is of use. Raises TypeError."""
    if not isinstance(given, list):
        raise TypeError(f"gave {_kind(given)}, must be a list of lines")
    more = [f"... and {len(given) - LINES} more lines"] if len(given) > LINES else []
    return [str(line) for line in given[:LINES]] + more


def counters(given: object) -> dict[str, int]:
    """What `counters` gave, as far as it is of use. Raises TypeError."""
    if not isinstance(given, dict):
        raise TypeError(f"gave {_kind(given)}, must be a dict of whole numbers")
    return {name: count for name, count in list(given.items())[:LINE_COUNTERS] if _text(name) and _whole(count)}


def _frame(given: object) -> Frame:
    if type(given) is not Frame:
        raise TypeError(f"gave {_kind(given)}, must be Frame")
    if type(given.data) is not bytes or len(given.data) > BYTES:
        raise TypeError(f"gave a frame whose data is {_kind(given.data)}, must be at most {BYTES} bytes")
    if not _whole(given.arrival_ns) or not _text(given.channel) or type(given.inbound) is not bool:
        raise TypeError("gave a frame whose arrival_ns, channel or inbound is not of its type")
    return given


def _message(given: object, nx: int) -> None:
    if type(given) is Observation:
        wanted = (0, nx) if given.fault else (nx,)
        if not _whole(given.seq) or not _whole(given.stamp_ns) or not _text(given.fault):
            raise TypeError("gave an Observation whose seq, stamp_ns or fault is not of its type")
        if not _vector(given.x) or len(given.x) not in wanted:
            raise TypeError(f"gave an Observation with x {_brief(given.x)}, must be a tuple of {nx} finite floats")
    elif type(given) is Command:
        if not all(map(_whole, (given.seq, given.t_ns, given.obs_seq, given.ttl_ns))) or not _text(given.source) or not _text(given.fault):
            raise TypeError("gave a Command whose fields are not of their types")
        if not _vector(given.u):
            raise TypeError(f"gave a Command with u {_brief(given.u)}, must be a tuple of finite floats")
    elif type(given) is LinkChanged:
        if type(given.up) is not bool or not _text(given.detail) or not _whole(given.t_ns):
            raise TypeError("gave a LinkChanged whose up, detail or t_ns is not of its type")
    elif type(given) is OverrideChanged:
        if given.kind not in KINDS or not _text(given.detail) or not _whole(given.t_ns):
            raise TypeError("gave an OverrideChanged whose kind, detail or t_ns is not what it may be")
    elif type(given) is ObservationRefused:
        if not _text(given.detail) or not _whole(given.t_ns):
            raise TypeError("gave an ObservationRefused whose detail or t_ns is not of its type")
    else:
        raise TypeError(f"gave {_kind(given)}, must be Observation, ObservationRefused, Command, LinkChanged or OverrideChanged")


def _override(given: object) -> OverrideChanged | None:
    """An override as it may be: a text that is too long is cut, one that is none is left out, for a person's stop must not hang on it."""
    if not isinstance(given, OverrideChanged) or type(given.kind) is not str or given.kind not in KINDS:
        return None
    detail = given.detail[:TEXT] if type(given.detail) is str else ""
    t_ns = given.t_ns if _whole(given.t_ns) else 0
    return OverrideChanged(t_ns, given.kind, detail if _text(detail) else ascii(detail)[:TEXT])


def _whole(value: object) -> TypeGuard[int]:
    """An int that fits into 64 bits, as everything that is logged must."""
    return type(value) is int and -(1 << 63) <= value < 1 << 63


def _text(value: object) -> TypeGuard[str]:
    """Text that can be written as UTF-8 (no lone surrogates), and is no novel."""
    return type(value) is str and len(value) <= TEXT and (value.isascii() or not any("\ud800" <= c <= "\udfff" for c in value))


def _vector(value: object) -> bool:
    if type(value) is not tuple or len(value) > COMPONENTS:
        return False
    return all(type(v) is float and math.isfinite(v) for v in cast("tuple[object, ...]", value))


def _kind(value: object) -> str:
    return f"{len(value)} of {type(value).__name__}" if isinstance(value, list | tuple | bytes) else type(value).__name__


def _brief(value: object) -> str:
    return repr(value)[:80]
