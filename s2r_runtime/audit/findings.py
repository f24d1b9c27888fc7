"""What an audit finds: the first difference, what was recomputed, what could not be, what is missing, which certificates stand."""

from __future__ import annotations

import math
from typing import Any

import msgspec

RELATIVE = 1e-9
"""How far a number from another platform's arithmetic may be off (docs/log-format.md)."""
SHOWN = 600
"""Characters of a record in a difference."""


class Difference(msgspec.Struct, frozen=True):
    """A record that does not follow from those before it. `index`: its number in the run."""

    file: str
    index: int
    channel: str
    what: str
    recorded: str
    recomputed: str


class CertificateFinding(msgspec.Struct):
    """Whether the log carries what a certificate says, and why (not)."""

    id: str
    valid: bool
    reason: str


class ModelFinding(msgspec.Struct):
    """A model that was put in force: who decided, and where it is from."""

    digest: str
    adopted_by: str
    origin: str


class Findings:
    """Collects. `file`, `same_platform`, `same_machine` (and processor): of what is being read now."""

    def __init__(self) -> None:
        self.file = ""
        self.files: list[str] = []
        """Names of all files, in order."""
        self.same_platform = self.same_machine = True
        self.first: Difference | None = None
        self.differences = 0
        self.counts: dict[str, int] = {}
        self.unchecked: dict[str, None] = {}
        self.incomplete: dict[str, None] = {}
        self.missing: list[str] = []
        self.skipped: dict[str, None] = {}
        self.models: list[ModelFinding] = []
        self.certificates: dict[str, CertificateFinding] = {}

    def differ(self, index: int, channel: str, what: str, recorded: Any, recomputed: Any) -> None:
        """A difference; the first one is kept."""
        self.differences += 1
        if self.first is None:
            self.first = Difference(self.file, index, channel, what, _shown(recorded), _shown(recomputed))

    def count(self, what: str, n: int = 1) -> None:
        """So many of these were recomputed."""
        self.counts[what] = self.counts.get(what, 0) + n

    def cannot(self, what: str) -> None:
        """Something that is there could not be recomputed here: no pass."""
        self.unchecked[what] = None

    def incomplete_input(self, what: str) -> None:
        """Parts of a run were not given, so that what is there could not be recomputed: neither passed nor failed."""
        self.incomplete[what] = None

    def skip(self, what: str) -> None:
        """Something could be recomputed here, but nobody asked for so much: neither passed nor failed."""
        self.skipped[what] = None

    def lack(self, what: str) -> None:
        """Something is not in what was given. That is no difference."""
        if what not in self.missing:
            self.missing.append(what)

    def add(self, other: Findings) -> None:
        """What was found in another process, about the same files."""
        self.differences += other.differences
        if other.first is not None and (self.first is None or self._place(other.first) < self._place(self.first)):
            self.first = other.first
        for what, n in other.counts.items():
            self.count(what, n)
        for one in other.missing:
            self.lack(one)
        self.unchecked |= other.unchecked
        self.incomplete |= other.incomplete

    def _place(self, one: Difference) -> tuple[int, int]:
        return self.files.index(one.file) if one.file in self.files else -1, one.index


def close(a: Any, b: Any) -> bool:
    """Equal, but for numbers that are within RELATIVE of each other. a, b: plain data."""
    if isinstance(a, float) or isinstance(b, float):
        if not (isinstance(a, int | float) and isinstance(b, int | float)):
            return False
        return a == b or math.isclose(a, b, rel_tol=RELATIVE, abs_tol=1e-300)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(close(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(close, a, b))
    return bool(a == b)


def alike(a: msgspec.Struct, b: msgspec.Struct) -> bool:
    """As `close`, of two messages."""
    return type(a) is type(b) and (a == b or close(msgspec.to_builtins(a), msgspec.to_builtins(b)))


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str):
        text = value or "nothing"
    elif isinstance(value, bytes):
        text = value.decode(errors="replace")
    else:
        text = msgspec.json.encode(value).decode()
    return text if len(text) <= SHOWN else text[:SHOWN] + "…"
