"""Named time series: what a reader gives of any file, and the interface of a reader (hook `s2r_formats`).

    file -> topics (name, type, fields) -> runs of samples (t, values of a field)

A *topic* is whatever shares stamps: a ROS topic, a ULog or DataFlash message, a channel group of an MF4 file, a table (no name).
A *signal* is one number of it, `TOPIC.FIELD`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Topic(NamedTuple):
    """fields: name -> unit ("" where none is known), numbers only. n: messages; first_s, last_s: their stamps (NaN without any).

    note: why it cannot be used, or what a reader should know; empty fields and no note: it holds no number. lasts_s: of all runs together,
    where there are several, whose stamps may begin anew.
    """

    name: str
    kind: str
    n: int
    first_s: float
    last_s: float
    fields: Mapping[str, str]
    note: str = ""
    lasts_s: float = 0.0

    @property
    def rate(self) -> float:
        """Messages a second; 0 where fewer than two stamps differ."""
        span = self.lasts_s or self.last_s - self.first_s
        return (self.n - 1) / span if self.n > 1 and span > 0.0 else 0.0


class Samples(NamedTuple):
    """t: (N,) s, of the clock that all topics of the file share (of a bag: when it was recorded). values: field -> (N,). stamps: (N,) s, of
    the sender's own clock, where the messages carry one, else None.
    """

    t: Array
    values: Mapping[str, Array]
    stamps: Array | None = None


@dataclass(frozen=True)
class Run:
    """A contiguous part of a recording: topic -> samples. name: what the file calls it, or ""."""

    samples: Mapping[str, Samples]
    name: str = ""


class Opened(Protocol):
    """A file that a reader of `s2r_formats` opened. kind: what it is, in words ("PX4 ULog"). drawn: its runs are samples of a campaign, as
    the segments of a table are; else they are ordinary driving. notes: what the user should know of how it was read.
    """

    kind: str
    drawn: bool
    notes: list[str]

    def topics(self) -> Sequence[Topic]:
        """What there is. Raises RecordingError."""

    def read(self, wanted: Mapping[str, Sequence[str]]) -> Sequence[Run]:
        """Samples of these fields, topic -> fields, run after run. Raises RecordingError."""


class Reader(Protocol):
    """What the hook `s2r_formats` offers: `open(path) -> Opened`; raises RecordingError, and ImportError where a library is missing."""

    def open(self, path: Path) -> Opened:
        """Opens the file; it was recognised before (`recognise`)."""


@dataclass
class InMemory:
    """Everything at once: the `Opened` of readers whose libraries do not stream. topic: name -> (kind, samples, units, note)."""

    kind: str
    runs: Sequence[Run]
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    kinds: Mapping[str, str] = field(default_factory=dict)
    unusable: Sequence[Topic] = ()
    drawn: bool = False
    notes: list[str] = field(default_factory=list)

    def topics(self) -> list[Topic]:
        """Topics of all runs together."""
        names = dict.fromkeys(name for run in self.runs for name in run.samples)
        return [self._topic(name) for name in names] + list(self.unusable)

    def _topic(self, name: str) -> Topic:
        parts = [run.samples[name] for run in self.runs if name in run.samples]
        stamps = np.concatenate([part.t for part in parts])
        first, last = (float(np.min(stamps)), float(np.max(stamps))) if len(stamps) else (float("nan"),) * 2
        units = self.units.get(name, {})
        fields = {one: units.get(one, "") for part in parts for one in part.values}
        return Topic(name, self.kinds.get(name, ""), len(stamps), first, last, fields)

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """The fields that are wanted."""
        found = []
        for run in self.runs:
            kept = {
                name: Samples(run.samples[name].t, {one: run.samples[name].values[one] for one in fields}, run.samples[name].stamps)
                for name, fields in wanted.items()
                if name in run.samples
            }
            found.append(Run(kept, run.name))
        return found
