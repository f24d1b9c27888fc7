"""How the command line speaks: results on stdout, everything else on stderr, progress only on a terminal."""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any, TextIO

import msgspec

_STYLES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33"}


def out(text: str = "") -> None:
    """A line of the result."""
    sys.stdout.write(text + "\n")


def err(text: str = "") -> None:
    """A line about it."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def result_json(value: Any) -> None:
    """One JSON object on stdout. Raises ValueError on a number that is not finite: JSON has no word for it."""
    out(json.dumps(msgspec.to_builtins(value), allow_nan=False))


def fail(message: str, code: int, *, as_json: bool = False, missing: int | None = None) -> None:
    """An error: one line on stderr, and with `--json` an object on stdout as well."""
    line = " ".join(message.split("\n"))
    err(f"s2r: {line}")
    if as_json:
        result_json({"error": line, "exit_code": code} | ({"missing_samples": missing} if missing else {}))


def styled(text: str, style: str, stream: TextIO | None = None) -> str:
    """Text with a terminal style, where there is a terminal and NO_COLOR is not set."""
    stream = stream or sys.stdout
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not stream.isatty():
        return text
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m"


class Progress:
    """One line on stderr that is drawn over, with the time left. Silent where stderr is no terminal."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._begin = time.monotonic()
        self._drawn = 0.0
        self._live = sys.stderr.isatty()

    def __call__(self, done: float, total: float, detail: str = "", seconds_left: float | None = None) -> None:
        """done of total; `seconds_left` if the caller knows better than the pace so far."""
        now = time.monotonic()
        if not self._live or (now - self._drawn < 0.1 and done < total):
            return
        self._drawn = now
        if seconds_left is None and done > 0:
            seconds_left = (now - self._begin) / done * max(total - done, 0.0)
        share = min(max(done / total, 0.0), 1.0) if total else 0.0
        bar = "█" * int(24 * share) + "░" * (24 - int(24 * share))
        left = "" if seconds_left is None else f" · {_duration(seconds_left)} left"
        sys.stderr.write(f"\r\x1b[2K{self._label} {bar} {int(done)}/{int(total)}{left}{' · ' + detail if detail else ''}")
        sys.stderr.flush()

    def close(self) -> None:
        """Clears the line."""
        if self._live and self._drawn:
            sys.stderr.write("\r\x1b[2K")
            sys.stderr.flush()


def _duration(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60:02d} s"
