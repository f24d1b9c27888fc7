"""Readers whose libraries take in a file at once, in a process of their own: a damaged file may crash a library or fill the memory.

    parent -> child   one JSON line: {"reader", "path", "options", "wanted"} (wanted: topic -> fields, or null: the topics)
    child -> parent   u64 length, JSON header, then the arrays of its runs as little-endian float64, in the order of the header

The process is started with the first such file and serves all that follow. One that crashes, or takes longer than TIMEOUT_S, is a file that
cannot be read; the next file gets a new process. Its memory is bounded by the file's size (`limits.RATIO`), whatever the file claims: a
library unpacks what a block or a page holds, not what the table of contents says.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.files.limits import RATIO
from s2r_runtime.recordings.formats.series import Array, Opened, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import HARMLESS, NUMBER_BYTES

TIMEOUT_S = 600.0
ADDRESS_SPACE = 12_000_000_000
"""Bytes: the largest file, its numbers, and the libraries."""
LIBRARY_BYTES = 256 << 20
"""Of memory that a reader's library takes itself: its code, its arenas, the stacks of its threads."""
FULL = "does not fit into memory"
HEADER_BYTES = 1 << 30
BLOCK = 1 << 20


class IsolatedFile:
    """`Opened`, of a reader in the other process. what: the form in words, for errors. Raises ImportError as the reader does."""

    def __init__(self, path: Path, reader: str, what: str, options: Mapping[str, Any] | None = None) -> None:
        self._path, self._reader, self._what, self._options = path, reader, what, dict(options or {})
        answer, _ = self._asked(None)
        self.kind: str = answer["kind"]
        self.drawn: bool = answer["drawn"]
        self.notes: list[str] = answer["notes"]
        self._topics = [
            Topic(name, kind, n, math.nan if first is None else first, math.nan if last is None else last, fields, note, lasts)
            for name, kind, n, first, last, fields, note, lasts in answer["topics"]
        ]

    def topics(self) -> Sequence[Topic]:
        """What there is."""
        return self._topics

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of these fields."""
        answer, arrays = self._asked({name: list(fields) for name, fields in wanted.items()})
        self.notes = answer["notes"]
        left = iter(arrays)
        runs = []
        for run in answer["runs"]:
            samples = {}
            for name, fields, stamped, _ in run["samples"]:
                t, stamps = next(left), next(left) if stamped else None
                samples[name] = Samples(t, {field: next(left) for field in fields}, stamps)
            runs.append(Run(samples, run["name"]))
        return runs

    def _asked(self, wanted: Mapping[str, list[str]] | None) -> tuple[Any, list[Array]]:
        request: dict[str, Any] = {"reader": self._reader, "path": str(self._path.absolute()), "name": str(self._path)}
        request |= {"options": self._options, "wanted": wanted}
        try:
            answer, arrays = _process().ask(request)
        except (OSError, EOFError, ValueError) as error:
            raise RecordingError(f"{self._path}: this is {self._what}, and cannot be read: {error}") from None
        if "missing" in answer:
            raise ImportError(answer["missing"], name=answer["missing"])
        if "error" in answer:
            raise RecordingError(answer["error"])
        return answer, arrays


# ---------------------------------------------------------------- the parent's end


class _Process:
    """The child, as long as it lives."""

    def __init__(self) -> None:
        self._child = subprocess.Popen(
            [sys.executable, "-m", "s2r_runtime.recordings.formats.isolated"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )

    @property
    def alive(self) -> bool:
        return self._child.poll() is None

    def ask(self, request: Any) -> tuple[Any, list[Array]]:
        """Its answer. Raises EOFError, with the reason, if it crashed or took too long."""
        until = time.monotonic() + TIMEOUT_S
        assert self._child.stdin is not None  # noqa: S101 - a pipe was asked for
        try:
            self._child.stdin.write(json.dumps(request).encode() + b"\n")
            self._child.stdin.flush()
            length = int.from_bytes(self._bytes(8, until), "little")
            if length > HEADER_BYTES:
                raise EOFError("its reader answered what is no answer")
            answer = json.loads(self._bytes(length, until))
            sizes = [
                n
                for run in answer.get("runs", [])
                for _, fields, stamped, n in run["samples"]
                for _ in range(1 + bool(stamped) + len(fields))
            ]
            return answer, [np.frombuffer(self._bytes(8 * n, until), dtype="<f8") for n in sizes]
        except (OSError, EOFError) as error:
            why = str(error) if isinstance(error, EOFError) and str(error) else self._ended()
            self.stop()
            raise EOFError(why) from None

    def _bytes(self, n: int, until: float) -> bytes:
        assert self._child.stdout is not None  # noqa: S101 - as above
        found = bytearray()
        number = self._child.stdout.fileno()
        while len(found) < n:
            if not select.select([number], [], [], max(0.0, until - time.monotonic()))[0]:
                raise EOFError(f"its library took longer than {TIMEOUT_S:g} s")
            block = os.read(number, min(BLOCK, n - len(found)))
            if not block:
                raise EOFError
            found += block
        return bytes(found)

    def _ended(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._child.wait(5.0)
            return (
                f"its library crashed on it ({signal.Signals(-code).name})" if code < 0 else f"its library ended the reader (exit {code})"
            )
        return "its reader does not answer"

    def stop(self) -> None:
        """Ends it."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


_running: list[_Process] = []


def _process() -> _Process:
    if not _running or not _running[0].alive:
        stop()
        _running.append(_Process())
    return _running[0]


@atexit.register
def stop() -> None:
    """Ends the process, if there is one."""
    while _running:
        _running.pop().stop()


# ---------------------------------------------------------------- the child's end


def _serve(requests: IO[bytes], answers: IO[bytes]) -> None:
    opened: dict[tuple[str, str, int, str], Opened] = {}
    for line in requests:
        header, arrays = _answer(json.loads(line), opened)
        data = json.dumps(header).encode()
        answers.write(len(data).to_bytes(8, "little") + data)
        for array in arrays:
            answers.write(np.ascontiguousarray(array, dtype="<f8").data)
        answers.flush()


def _answer(request: Any, opened: dict[tuple[str, str, int, str], Opened]) -> tuple[dict[str, Any], list[Array]]:
    """Header and arrays. One file stays open between its topics and its samples."""
    path = Path(request["path"])
    try:
        with _bounded_by(path):
            return _read(path, request, opened)
    except ImportError as error:
        return {"missing": error.name or str(error)}, []
    except RecordingError as error:
        said = str(error).replace(str(path), request["name"])
        return {"error": _full(request["name"]) if said.endswith(FULL) else said}, []
    except MemoryError:
        return {"error": _full(request["name"])}, []
    except Exception as error:  # noqa: BLE001 - a library's, at bytes that nobody foresaw
        return {"error": f"{request['name']}: cannot be read: {type(error).__name__}: {one_line(str(error), 120)}"}, []


def _full(name: str) -> str:
    return f"{name}: {FULL}: its reader takes more than {RATIO.value():g} times the file's size; {RATIO.more()}"


@contextlib.contextmanager
def _bounded_by(path: Path) -> Iterator[None]:
    """The process may take as much more memory as a file of this size can be packed from, and its library. path: or a folder."""
    try:
        files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
        size = sum(file.stat().st_size for file in files)
        now = int(Path("/proc/self/status").read_text(encoding="ascii").partition("VmData:")[2].split()[0]) << 10
    except (OSError, IndexError):  # its reader says what is wrong; or no Linux: the address space is bounded
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = now + LIBRARY_BYTES + HARMLESS * NUMBER_BYTES + round(RATIO.value() * size)
    resource.setrlimit(resource.RLIMIT_DATA, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _read(path: Path, request: Any, opened: dict[tuple[str, str, int, str], Opened]) -> tuple[dict[str, Any], list[Array]]:
    from s2r_runtime.plugins import registry

    key = (request["reader"], str(path), path.stat().st_mtime_ns, json.dumps(request["options"], sort_keys=True))
    if key not in opened:
        opened.clear()
        opened[key] = registry().get("formats", request["reader"])(path, **request["options"])
    file = opened[key]
    if request["wanted"] is None:
        topics = [
            [t.name, t.kind, t.n, *(s if math.isfinite(s) else None for s in (t.first_s, t.last_s)), dict(t.fields), t.note, t.lasts_s]
            for t in file.topics()
        ]
        return {"kind": file.kind, "drawn": file.drawn, "notes": file.notes, "topics": topics}, []
    runs = file.read(request["wanted"])
    listed, arrays = [], []
    for run in runs:
        samples = []
        for name, one in run.samples.items():
            samples.append([name, list(one.values), one.stamps is not None, len(one.t)])
            arrays += [one.t, *([] if one.stamps is None else [one.stamps]), *one.values.values()]
        listed.append({"name": run.name, "samples": samples})
    return {"notes": file.notes, "runs": listed}, arrays


def main() -> None:
    """Serves until its parent is gone. What libraries print goes nowhere."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with contextlib.suppress(BrokenPipeError):
        _serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    main()
