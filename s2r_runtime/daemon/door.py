"""The door of the control socket: a line becomes a `Request`, or is refused in one line.

This runs in the gate's process, so it may neither fail nor take long, whatever the line holds. A line is scanned once. Short fields are
decoded and checked here: UTF-8 text of bounded length without control characters, numbers that are finite and not negative. Fields that
may be large (parameters, a certificate, a model) stay the bytes that they are; a worker process reads them (`jobs`), whose death or
overtime refuses that one request.
"""

from __future__ import annotations

import math

import msgspec

from s2r_runtime.errors import ConfigError, UsageError, one_line
from s2r_runtime.messages import Scenarios

TEXT_MAX = 200
"""Characters of a reason, an id or a stretch; the longest id of a certificate has 71."""
PATH_MAX = 4096
"""Bytes, as PATH_MAX of Linux."""
ESCAPED = 6
"""Bytes that JSON takes for one character at most, as in \\u0041."""
NUMBER_MAX = 40
"""Digits of a number."""
COUNT_MAX = 2**31
SEED_MAX = 2**53
"""Exact in every JSON reader."""
NOTHING, NO_TEXT, NO_TABLE = msgspec.Raw(b""), msgspec.Raw(b'""'), msgspec.Raw(b"{}")


class _Line(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request's fields as they came, each checked to be JSON and no more."""

    verb: msgspec.Raw
    path: msgspec.Raw = NO_TEXT
    parameters: msgspec.Raw = NO_TABLE
    certificate: msgspec.Raw = NO_TEXT
    text: msgspec.Raw = NO_TEXT
    base: msgspec.Raw = NO_TEXT
    duration_s: msgspec.Raw = msgspec.Raw(b"0")
    count: msgspec.Raw = msgspec.Raw(b"0")
    seed: msgspec.Raw = msgspec.Raw(b"0")
    first: msgspec.Raw = msgspec.Raw(b"0")
    detached: bool = False


class Request(msgspec.Struct, frozen=True):
    """What a client may ask. deploy: path, parameters, certificate (text), scenarios (from its `seed`, `first` and `count`).
    adopt: `model`, the text of the model's TOML, base its folder;
    no text: the proposed one. excite: path. trace: text says what. detached (sample, excite): answered when it drives, and not stopped when
    the client is gone. parameters, certificate and model are JSON that nobody has decoded.
    """

    verb: str
    path: str = ""
    parameters: msgspec.Raw = NO_TABLE
    certificate: msgspec.Raw = NO_TEXT
    model: msgspec.Raw = NO_TEXT
    text: str = ""
    base: str = ""
    duration_s: float = 0.0
    count: int = 0
    detached: bool = False
    scenarios: Scenarios | None = None


_DECODE = msgspec.json.Decoder(_Line).decode


def decode_request(line: bytes) -> Request:
    """Raises UsageError or ConfigError, in one line, for what is no request."""
    try:
        came = _DECODE(line)
    except (ValueError, RecursionError) as error:  # msgspec's and Unicode's errors are ValueErrors
        raise UsageError(f"the request is not understood: {one_line(str(error))}") from None
    verb = _text(came.verb, "verb", TEXT_MAX)
    if not verb:
        raise UsageError('the request must be an object with a "verb"')
    duration_s, count = _number(came.duration_s, f"{verb}: duration_s"), _whole(came.count, f"{verb}: count", COUNT_MAX)
    seed, first = _whole(came.seed, f"{verb}: seed", SEED_MAX), _whole(came.first, f"{verb}: first", COUNT_MAX)
    return Request(
        verb,
        _text(came.path, f"{verb}: path", PATH_MAX),
        came.parameters,
        came.certificate,
        came.text if verb == "adopt" else NO_TEXT,
        "" if verb == "adopt" else _text(came.text, f"{verb}: text", TEXT_MAX),
        _text(came.base, f"{verb}: base", PATH_MAX),
        duration_s,
        count,
        came.detached,
        Scenarios(seed, first, count) if verb == "deploy" and count else None,
    )


def _text(raw: msgspec.Raw, where: str, most: int) -> str:
    """A short text. Raises UsageError naming what is wrong with it."""
    data = bytes(raw)
    try:
        value = "" if len(data) > ESCAPED * most + 2 else msgspec.json.decode(data, type=str)
    except ValueError as error:
        raise UsageError(f"{where}: is no UTF-8 text: {one_line(str(error))}") from None
    if len(data) > ESCAPED * most + 2 or len(value.encode()) > most:
        raise UsageError(f"{where}: is longer than {most} bytes")
    if any(c < " " or "\x7f" <= c <= "\x9f" for c in value) or (most == TEXT_MAX and not value.isprintable()):
        raise UsageError(f"{where}: holds characters that cannot be printed: {one_line(value, 60)!r}")
    return value


def _whole(raw: msgspec.Raw, where: str, below: int) -> int:
    """Raises UsageError, ConfigError."""
    value = _number(raw, where)
    if value != int(value) or value >= below:
        raise ConfigError(f"{where} is {value:g}, must be a whole number >= 0 and below 2^{below.bit_length() - 1}")
    return int(value)


def _number(raw: msgspec.Raw, where: str) -> float:
    data = bytes(raw)
    shown = one_line(data[:60].decode(errors="replace"), 40)
    try:
        value = math.inf if len(data) > NUMBER_MAX else msgspec.json.decode(data, type=float, strict=False)
    except ValueError:
        raise UsageError(f"{where} is {shown}, must be a number") from None
    if not 0.0 <= value < math.inf:
        raise ConfigError(f"{where} is {shown}, must be >= 0 and finite")
    return value
