"""Logs: `s2r audit` and `s2r.audit` recompute one, `s2r.read_log` gives its channels as arrays or DataFrames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from s2r_runtime.api.progress import Callback, Report, Watcher, watcher_of
from s2r_runtime.api.results import AFTER, LIMIT, MEASURED, Result, axes_of
from s2r_runtime.api.spelling import front_door
from s2r_runtime.audit.log import AuditResult
from s2r_runtime.audit.log import audit as run_audit
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, RecordingError, UsageError
from s2r_runtime.messages import GateChanged, Started
from s2r_runtime.recording.logs import runs
from s2r_runtime.recording.salvage import info
from s2r_runtime.trust import keys, revocations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

HEAD_BYTES = 32
"""Of a head of a log's chain."""
STATES = {"event/observed": "observation.x"}
INPUTS = {"out/send": "u", "event/proposed": "command.u"}
"""Channel -> what is listed there in the order of the model's states, or inputs."""
OBSERVED, GATE, STARTED = "event/observed", "out/gate_changed", "event/started"

Column = np.ndarray[Any, Any]


# ---------------------------------------------------------------- audit


@dataclass(frozen=True, eq=False, repr=False)
class Audit(Result):
    """What an audit recomputed, and the first record that differs."""

    result: AuditResult

    @property
    def ok(self) -> bool:
        """Whether everything that is there was recomputed and holds."""
        return self.result.ok

    @property
    def chain(self) -> str:
        """`intact`, `broken` or `unsigned tail`."""
        return self.result.chain

    @property
    def records(self) -> int:
        """Number of records."""
        return self.result.records

    @property
    def first_difference(self) -> dict[str, Any] | None:
        """None, or `file`, `index`, `channel`, `what`, `recorded`, `recomputed`."""
        found: dict[str, Any] | None = msgspec.to_builtins(self.result.first_difference)
        return found

    @property
    def exit_code(self) -> int:
        """Of `s2r audit`: 0 it holds, 1 it does not, 3 parts that are needed were not given."""
        return NotEnoughEvidence.exit_code if self.result.only_incomplete else 0 if self.ok else 1

    def to_dict(self) -> dict[str, Any]:
        """What `s2r audit --json` prints."""
        return self.result.to_json()

    def summary(self) -> str:
        """What `s2r audit` prints."""
        return self.result.text()

    def plot(self, ax: Axes | None = None) -> Axes:
        """How many records of each kind were recomputed. Returns the axes."""
        (here,) = axes_of(1, ax)
        here.barh(list(self.result.recomputed), list(self.result.recomputed.values()), color=AFTER if self.ok else LIMIT)
        here.set_xlabel("recomputed")
        return here


@front_door
def audit(
    log: str | Path | Sequence[str | Path],
    *,
    key: str | Path | None = None,
    rerun_controllers: bool = False,
    rerun_traces: bool = False,
    head: Sequence[str | bytes] | str | bytes = (),
    progress: Callback | bool | None = None,
) -> Audit:
    """Recomputes every number and every decision of a run from its log alone.

    log: the run's file, or all its files. key: the public key to trust (default: the one in the log, which shows consistency only).
    rerun_controllers: run the attached controllers again, confined. rerun_traces: run every trace again, however long it takes. head: heads
    of the chain that the log must reach, 64 hexadecimal digits or 32 bytes each. progress: a function that takes a `Step`; True: tqdm.

    A log that does not hold gives `ok == False`. Raises UsageError (no such file), RecordingError (no log), ConfigError (key),
    NotEnoughEvidence (no record can be read).
    """
    heads = [head] if isinstance(head, str | bytes) else list(head)
    return audited(
        _paths(log), watcher_of(progress), key=None if key is None else Path(key), rerun_controllers=rerun_controllers,
        rerun_traces=rerun_traces, heads=[_head(one) for one in heads],
    )  # fmt: skip


def audited(
    paths: Sequence[Path], watcher: Watcher, *, key: Path | None, rerun_controllers: bool, rerun_traces: bool, heads: Sequence[bytes]
) -> Audit:
    """As `audit`."""
    need_files(paths)
    with watcher.phase("auditing") as report:
        found = run_audit(
            paths,
            public_key=keys.load_public(key) if key else None,
            rerun_controllers=rerun_controllers,
            rerun_traces=rerun_traces,
            heads=heads,
            revoked=revocations.known(revocations.places()),
            progress=report,
        )
    return Audit(found)


def need_files(paths: Sequence[Path]) -> None:
    """Raises UsageError for a path that is no file."""
    for path in paths:
        if not path.is_file():
            raise UsageError(f"{path}: no such log file")


def _head(given: str | bytes) -> bytes:
    try:
        head = given if isinstance(given, bytes) else bytes.fromhex(given)
    except ValueError:
        head = b""
    if len(head) != HEAD_BYTES:
        raise UsageError(f"--head: {given!r} is no head of a log's chain, must be {2 * HEAD_BYTES} hexadecimal digits")
    return head


def _paths(log: str | Path | Sequence[str | Path]) -> list[Path]:
    if not isinstance(log, str | Path | Sequence):
        raise TypeError(f"log: is {type(log).__name__}, must be a path or several")
    several = [log] if isinstance(log, str | Path) else list(log)
    if wrong := [one for one in several if not isinstance(one, str | Path)]:
        raise TypeError(f"log: is {type(wrong[0]).__name__}, must be a path or several")
    if not several:
        raise UsageError("log: the list is empty, must name at least one file")
    return [Path(one) for one in several]


# ---------------------------------------------------------------- channels


@dataclass(frozen=True, eq=False, repr=False)
class Log(Result):
    """A log of the daemon. Its channels are read when they are needed, each in one pass over the files."""

    paths: tuple[Path, ...]
    parts: tuple[dict[str, Any], ...]
    """For each file what `s2r log info --json` prints."""
    started: Started | None = field(repr=False, default=None)
    first_ns: int = 0

    @property
    def channels(self) -> dict[str, int]:
        """Number of messages by channel."""
        found: dict[str, int] = {}
        for part in self.parts:
            for name, n in part["channels"].items():
                found[name] = found.get(name, 0) + n
        return found

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the model's states."""
        return self.started.settings.states if self.started else ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the model's inputs."""
        return self.started.settings.inputs if self.started else ()

    @property
    def duration_s(self) -> float:
        """From the first record to the last, of all parts together."""
        return float(sum(part["duration_s"] for part in self.parts))

    def arrays(self, channel: str, *, progress: Callback | bool | None = None) -> dict[str, Column]:
        """The messages of a channel by field: name -> (n,).

        `t_s` is the log's time in s since its first record. A nested field is `observation.seq`. States and inputs have the names of the
        model, in SI units and radians; other lists are `field[0]`, `field[1]`, ... Numbers are float64, NaN where a message has none;
        whole numbers are int64, flags bool, and everything else is of type object. Raises UsageError for a channel that is not there.
        """
        if channel not in self.channels:
            raise UsageError(f"{', '.join(map(str, self.paths))}: has no channel {channel!r}; it has: {', '.join(sorted(self.channels))}")
        stamps: list[float] = []
        columns: dict[str, list[Any]] = {}
        with watcher_of(progress).phase("reading") as report:
            for n, entry in enumerate(self._entries(channel)):
                stamps.append((entry.log_time_ns - self.first_ns) * 1e-9)
                message = self._flat(channel, msgspec.json.decode(entry.raw))
                for name, value in message.items():
                    columns.setdefault(name, [None] * n).append(value)
                if len(message) < len(columns):
                    for column in columns.values():
                        column.extend([None] * (n + 1 - len(column)))
                report(n + 1, self.channels[channel])
        return {"t_s": np.array(stamps), **{name: _column(column) for name, column in columns.items()}}

    def frame(self, channel: str, *, progress: Callback | bool | None = None) -> DataFrame:
        """As `arrays`, as a pandas DataFrame. Raises ConfigError without pandas."""
        try:
            from pandas import DataFrame
        except ImportError:
            raise ConfigError("frame: needs pandas: pip install pandas; or polars.DataFrame(log.arrays(channel))") from None
        return DataFrame(self.arrays(channel, progress=progress))

    def to_dict(self) -> dict[str, Any]:
        """What `s2r log info --json` prints; of several files `parts`, one each."""
        return dict(self.parts[0]) if len(self.parts) == 1 else {"parts": list(self.parts)}

    def summary(self) -> str:
        """Its files, how they ended, and the number of messages by channel."""
        last = self.parts[-1]
        lines = [f"{sum(part['records'] for part in self.parts)} records in {', '.join(path.name for path in self.paths)}"]
        lines.append(
            f"{self.duration_s:.4g} s; ended: {last['ended']}{': ' + last['detail'] if last['detail'] else ''}; chain {last['chain']}"
        )
        if self.started:
            lines.append(f"robot {self.started.settings.robot}, states {', '.join(self.states)}, inputs {', '.join(self.inputs)}")
        return "\n".join([*lines, *(f"  {name:30s} {n}" for name, n in sorted(self.channels.items()))])

    def plot(self, ax: Axes | None = None) -> list[Axes]:
        """Observed states over time, shaded where the gate was open; with `ax`, all states there. Returns the axes."""
        if not self.states or OBSERVED not in self.channels:
            raise UsageError("plot: the log holds no observation")
        seen = self.arrays(OBSERVED)
        axes = axes_of(len(self.states), ax, height_in=1.4)
        for k, name in enumerate(self.states):
            here = axes[min(k, len(axes) - 1)]
            here.plot(seen["t_s"], seen[name], color=MEASURED if ax is None else None, linewidth=0.9, label=name)
            here.set_ylabel(name)
        for begin, end in self._open_spans(float(seen["t_s"][-1])):
            for here in axes:
                here.axvspan(begin, end, color=AFTER, alpha=0.15, linewidth=0)
        axes[-1].set_xlabel("t (s), shaded: gate open")
        return axes

    def _open_spans(self, end: float) -> list[tuple[float, float]]:
        spans, begin = [], None
        for entry in self._entries(GATE) if GATE in self.channels else ():
            t, message = (entry.log_time_ns - self.first_ns) * 1e-9, entry.message
            if isinstance(message, GateChanged):
                if begin is not None and not message.open:
                    spans.append((begin, t))
                begin = (t if begin is None else begin) if message.open else None
        return [*spans, *([(begin, end)] if begin is not None else [])]

    def _entries(self, channel: str) -> Iterator[Any]:
        """Messages in order. Raises RecordingError where a file is damaged."""
        for parts in runs(self.paths, [channel]):
            for reading in parts:
                yield from reading
                if reading.ending.kind == "broken":
                    raise RecordingError(f"{reading.path}: is damaged {reading.ending.detail}; s2r log recover writes what is readable")

    def _flat(self, channel: str, message: Mapping[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        named = {STATES.get(channel, ""): self.states, INPUTS.get(channel, ""): self.inputs}
        for name, value in _fields("", message):
            if not isinstance(value, list):
                found[name] = value
            elif not value or not all(isinstance(one, float | int) for one in value):
                found[name] = value or None
            else:
                columns = named.get(name, ())
                if len(columns) != len(value):
                    columns = tuple(f"{name}[{k}]" for k in range(len(value)))
                found.update(zip(columns, value, strict=True))
        return found


@front_door
def read_log(log: str | Path | Sequence[str | Path], *, progress: Callback | bool | None = None) -> Log:
    """A log of the daemon: its channels as arrays or DataFrames.

    log: one file, or all files of a run. CRC, chain and signatures are checked while it is read. A log that was cut gives what is there.
    Raises UsageError (no such file), RecordingError (no log, or damaged).
    """
    paths, watcher = _paths(log), watcher_of(progress)
    need_files(paths)
    ordered = [reading.path for parts in runs(paths) for reading in parts]
    with watcher.phase("reading") as report:
        facts = []
        total, before = sum(path.stat().st_size for path in ordered), 0
        for path in ordered:
            facts.append(info(path, partial(_further, report, before, total, path.name)))
            before += path.stat().st_size
    if damaged := [(path, one) for path, one in zip(ordered, facts, strict=True) if one["ended"] == "broken"]:
        path, one = damaged[0]
        raise RecordingError(f"{path}: is damaged {one['detail']}; s2r log recover writes what is readable")
    first = None
    started: Started | None = None
    for parts in runs(ordered, [STARTED]):
        for reading in parts:
            for entry in reading:
                if isinstance(entry.message, Started):
                    started = entry.message
                    break
            first = reading.first_ns if first is None else first
    return Log(tuple(ordered), tuple(facts), started, first or 0)


def _further(report: Report, before: float, total: float, name: str, done: float, _size: float) -> None:
    """Progress within one of several files, in bytes."""
    report(before + done, total, name)


def _fields(prefix: str, message: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in message.items():
        if isinstance(value, dict):
            yield from _fields(f"{prefix}{name}.", value)
        elif name != "type":
            yield prefix + name, value


def _column(values: list[Any]) -> Column:
    """One field of all messages."""
    kinds = {type(value) for value in values}
    if kinds == {bool}:
        return np.array(values, dtype=bool)
    if kinds == {int} and all(abs(value) < 2**63 for value in values):
        return np.array(values, dtype=np.int64)
    if kinds <= {int, float, type(None)} and kinds != {type(None)}:
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    found = np.empty(len(values), dtype=object)
    found[:] = values
    return found
