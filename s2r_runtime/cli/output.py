"""How the command line speaks: results on stdout and in files that were asked for, all else on stderr, progress only on a terminal."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

import msgspec

from s2r_runtime.api.progress import Report, Watcher
from s2r_runtime.errors import UsageError
from s2r_runtime.files.printable import printable

_STYLE = f"\x1b{secrets.token_hex(8)}["
"""Begins a terminal style until `_shown` lets it through: no file can hold this, so no file can style."""
_STYLES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33"}


def stand_in_for_closed_streams() -> None:
    """Who starts a program with stdout or stderr closed wants to hear nothing there: Python then has None in its place."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - open as long as the program is


def out(text: str = "") -> None:
    """A line of the result. Raises UsageError if stdout does not take it (a full disk); a reader who has gone (`| head`) does not mind.

    What is not printable is shown as an escape (`printable`).
    """
    _to_stdout(_shown(text) + "\n")


def out_lines(text: str) -> None:
    """As `out`, of a text of several lines."""
    for line in text.split("\n"):
        out(line)


def _shown(text: str) -> str:
    """Printable, with the styles that `styled` put in."""
    parts = re.split(re.escape(_STYLE) + r"(\d+)m", text)
    return "".join(f"\x1b[{part}m" if k % 2 else printable(part) for k, part in enumerate(parts))


def flush() -> None:
    """Sends off the lines that are still waiting, where a failure can be said. Raises as `out`."""
    _to_stdout("")


def err(text: str = "") -> None:
    """A line about it. Nobody who reads it any more is no reason to end otherwise."""
    with contextlib.suppress(OSError):
        sys.stderr.write(_shown(" ".join(text.split("\n"))) + "\n")
        sys.stderr.flush()


def notes(source: str, lines: Sequence[str]) -> None:
    """What a person should know of how a recording was read, a line each."""
    for line in lines:
        err(f"s2r: {source}: {line}")


def _to_stdout(text: str) -> None:
    try:
        sys.stdout.write(text)
        if not text:
            sys.stdout.flush()
    except OSError as error:
        closed_terminal = error.errno == errno.EIO and stat.S_ISCHR(os.fstat(sys.stdout.fileno()).st_mode)
        # what is buffered would be tried again when Python ends, and complained about; what comes yet has nowhere to go either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not (isinstance(error, BrokenPipeError) or closed_terminal):
            raise UsageError(f"the result cannot be written to stdout: {error.strerror}") from None


def trouble_writing(path: Path, text: str) -> str:
    """As `write`, for a file beside which there is more to tell: what went wrong, or an empty text."""
    try:
        write(path, text)
    except UsageError as error:
        return str(error)
    return ""


def write(path: Path, text: str) -> None:
    """A file that was asked for, as a whole: what was there before stays if it cannot be written (a full disk). Raises UsageError."""
    try:
        if path.exists() and not (path.is_file() and os.access(path.resolve().parent, os.W_OK)):
            path.write_text(text, encoding="utf-8")  # /dev/stdout (a pipe has no place of its own), or a folder that takes no new file
            return
        target = path.resolve()
        temporary = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            temporary.write_text(text, encoding="utf-8")
            if target.exists():
                shutil.copymode(target, temporary)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None


def result_json(value: Any) -> None:
    """One JSON object on stdout. Raises ValueError on a number that is not finite: JSON has no word for it."""
    out(json.dumps(msgspec.to_builtins(value), allow_nan=False))


def fail(
    message: str, code: int, *, as_json: bool = False, missing: int | None = None, also: Mapping[str, object] = MappingProxyType({})
) -> None:
    """An error: one line on stderr, and with `--json` an object on stdout as well, with what there is also to tell."""
    line = " ".join(message.split("\n"))
    err(f"s2r: {line}")
    if as_json:
        with contextlib.suppress(UsageError):  # stdout may be what failed
            result_json({"error": line, "exit_code": code} | ({"missing_samples": missing} if missing else {}) | dict(also))


def styled(text: str, style: str, stream: TextIO | None = None) -> str:
    """Text with a terminal style, where there is a terminal and NO_COLOR is not set."""
    stream = stream or sys.stdout
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not stream.isatty():
        return text
    return f"{_STYLE}{_STYLES[style]}m{text}{_STYLE}0m"


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
        _draw(f"\r\x1b[2K{self._label} {bar} {int(done)}/{int(total)}{left}{' · ' + printable(detail) if detail else ''}")

    def close(self) -> None:
        """Clears the line."""
        if self._live and self._drawn:
            _draw("\r\x1b[2K")


class Terminal(Watcher):
    """Progress as one line that is drawn over, notes as lines on stderr."""

    def __init__(self) -> None:
        self._bar = Progress("")

    @contextmanager
    def phase(self, what: str) -> Iterator[Report]:
        """As `Progress`, with what is done as its label."""
        self._bar = bar = Progress(what)
        try:
            yield bar
        finally:
            bar.close()

    def line(self, text: str) -> None:
        """In the place of the progress."""
        self._bar.close()
        err(text)

    def notes(self, source: str, lines: Sequence[str]) -> None:
        """A line each."""
        notes(source, lines)


def _draw(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal closed
        sys.stderr.write(text)
        sys.stderr.flush()


def _duration(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60:02d} s"
