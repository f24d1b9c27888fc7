"""What a trace is made on: what was observed and commanded in a *stretch* of a log, picked out of its messages in their order.

    campaign   from the order to start the newest campaign to its end, over all logs in which it went on
    drive      while a controller drove, since the gap in force was found or this run began
    inputs     from the order to drive given inputs to their end: the newest ones, every time that they were driven in this run

All end with the record of the order to trace, at the latest. A stretch is a list of segments, in each of which the robot's clock runs
on and its link holds; a segment has rows of observations (the robot's stamp, x) and of commands (u, and the stamp of the observation that
it answers plus what the daemon took to answer). Where there are more observations than asked for, the newest are taken. The daemon's
worker reads a log through this, and the audit another time: the same messages give the same rows, and the same digest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import msgspec

from s2r_runtime.files.canonical import digest
from s2r_runtime.messages import (
    RESTARTS,
    CampaignFinished,
    EpochChanged,
    InputsFinished,
    LinkChanged,
    Observation,
    Observed,
    SampleTaken,
    Send,
    SourceStopped,
    StartCampaign,
    StartController,
    Started,
    StartInputs,
    StopController,
    Stretch,
    Struct,
)

CHANNELS = (
    "event/link_changed",
    "event/observed",
    "event/sample_taken",
    "event/campaign_finished",
    "event/inputs_finished",
    "event/source_stopped",
    "event/started",
    "out/send",
    "out/epoch_changed",
    "out/start_campaign",
    "out/start_controller",
    "out/stop_controller",
    "out/start_inputs",
    "out/start_job",
)
"""All that matters here, and the order to trace."""

ANSWERABLE = 1024
"""Observations that a command may still answer; it comes within a period or two."""

BEFORE = 64
"""Commands before a stretch that are taken along: what the robot does at first may be their doing."""
BEFORE_NS = 3_000_000_000

Rows = tuple[tuple[int, tuple[float, ...]], ...]


class Segment(Struct, frozen=True):
    """states: (stamp in ns, x), inputs: (stamp in ns, u), both by the robot's clock. run: the log's."""

    run: str
    states: Rows
    inputs: Rows


class Part(Struct, frozen=True):
    """From which record to which of a run, inclusive."""

    run: str
    first: int
    last: int


class Recorded(Struct, frozen=True):
    """Which rows a trace was made on. `digest`: of all of them, stamps included."""

    stretch: Stretch
    epoch: int
    parts: tuple[Part, ...]
    observations: int
    commands: int
    digest: str


class Cut(Struct, frozen=True):
    """A stretch, cut out of its logs. samples: of a campaign, by index."""

    about: Recorded
    segments: tuple[Segment, ...]
    samples: tuple[SampleTaken, ...] = ()


class _Segment:
    """One that grows: (record, stamp, values)."""

    def __init__(self, run: str, before: Iterable[tuple[int, int, tuple[float, ...]]]) -> None:
        self.run = run
        self.states: deque[tuple[int, int, tuple[float, ...]]] = deque()
        self.inputs = deque(before)


class _Window:
    """One stretch, its newest `limit` observations."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.epoch = 0
        self.open = False
        self.segments: deque[_Segment] = deque()
        self.count = 0

    def clear(self) -> None:
        self.segments.clear()
        self.count, self.open = 0, False

    def begin(self, segment: _Segment) -> None:
        self.open = True
        self.segments.append(segment)
        self.count += len(segment.states)

    def state(self, index: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        if not self.open:
            return
        self.segments[-1].states.append((index, stamp_ns, x))
        self.count += 1
        if self.count > self.limit:
            self._forget_one()

    def input(self, index: int, stamp_ns: int, u: tuple[float, ...]) -> None:
        if self.open:
            self.segments[-1].inputs.append((index, stamp_ns, u))

    def _forget_one(self) -> None:
        while not self.segments[0].states:
            self.segments.popleft()
        oldest = self.segments[0]
        oldest.states.popleft()
        self.count -= 1
        if not oldest.states:
            self.segments.popleft()
            return
        first_ns = oldest.states[0][1]
        while len(oldest.inputs) > 1 and oldest.inputs[1][1] < first_ns - BEFORE_NS:
            oldest.inputs.popleft()


class Stretches:
    """Takes a log's messages in, in their order; gives the stretches. limit: observations that are kept of each, the newest."""

    def __init__(self, limit: int) -> None:
        self._windows: dict[Stretch, _Window] = {"campaign": _Window(limit), "drive": _Window(limit), "inputs": _Window(limit)}
        self._samples: dict[int, SampleTaken] = {}
        self._notes_restarts = False
        self.begin_run("")

    def begin_run(self, run: str, limit: int | None = None) -> None:
        """Another log. A campaign may go on in it; nothing else does."""
        self._run, self._inputs = run, ""
        self._stamps: dict[int, tuple[int, int]] = {}
        self._last = (-1, -1)
        self._anew = False
        self._row: tuple[int, int, tuple[float, ...]] | None = None
        self._recent: deque[tuple[int, int, tuple[float, ...]]] = deque(maxlen=BEFORE)
        for stretch, window in self._windows.items():
            window.limit = window.limit if limit is None else limit
            window.open = False
            if stretch != "campaign":
                window.clear()

    def take(self, index: int, message: Struct) -> None:
        """The next message. index: its record's number in the run."""
        match message:
            case Observed(t_ns=t_ns, observation=observation) if not observation.fault:
                self._observed(index, t_ns, observation)
            case Send() if message.obs_seq in self._stamps:
                stamp_ns, seen_ns = self._stamps[message.obs_seq]
                row = (index, stamp_ns + max(message.t_ns - seen_ns, 0), message.u)
                self._recent.append(row)
                for window in self._windows.values():
                    window.input(*row)
            case Started(settings=settings):
                self._notes_restarts = settings.rules >= RESTARTS
            case LinkChanged() if self._notes_restarts:
                self._anew, self._row = True, None
                self._stamps.clear()
                self._recent.clear()
            case SampleTaken() if message.epoch == self._windows["campaign"].epoch:
                self._samples[message.index] = message  # one logged once more is the same; one that a crash took back is drawn anew
            case StartCampaign(epoch=epoch):
                window = self._windows["campaign"]
                if epoch != window.epoch:
                    window.clear()
                    window.epoch = epoch
                    self._samples.clear()
                self._begin("campaign")
            case CampaignFinished():
                self._windows["campaign"].open = False
            case EpochChanged() if message.gap is not None:
                self._windows["drive"].clear()
                self._windows["drive"].epoch = message.epoch
            case StartController():
                self._begin("drive")
            case StopController() | SourceStopped(source="controller"):
                self._windows["drive"].open = False
            case StartInputs(digest=inputs):
                if inputs != self._inputs:
                    self._windows["inputs"].clear()
                self._inputs = inputs
                self._begin("inputs")
            case InputsFinished():
                self._windows["inputs"].open = False
            case _:
                pass

    def cut(self, stretch: Stretch, epoch: int) -> Cut | None:
        """The stretch as it is now; None if there is nothing of it. epoch: which campaign; of the gap that the others are told by."""
        window = self._windows[stretch]
        if not window.count or (stretch == "campaign" and window.epoch != epoch):
            return None
        there = [one for one in window.segments if one.states]
        parts: dict[str, tuple[int, int]] = {}
        for one in there:
            records = [one.states[0][0], one.states[-1][0], *(row[0] for row in one.inputs)]
            first, last = parts.get(one.run, (records[0], records[0]))
            parts[one.run] = min(first, *records), max(last, *records)
        segments = tuple(
            Segment(one.run, tuple((t, x) for _, t, x in one.states), tuple((t, u) for _, t, u in one.inputs)) for one in there
        )
        about = Recorded(
            stretch,
            epoch,
            tuple(Part(run, first, last) for run, (first, last) in parts.items()),
            window.count,
            sum(len(one.inputs) for one in segments),
            digest(msgspec.json.encode([(one.states, one.inputs) for one in segments])),
        )
        samples = tuple(self._samples[i] for i in sorted(self._samples)) if stretch == "campaign" else ()
        return Cut(about, segments, samples)

    def _begin(self, stretch: Stretch) -> None:
        """What the sampler or controller is asked first is about the newest observation."""
        segment = _Segment(self._run, ())
        if self._row is not None:
            segment.inputs.extend(row for row in self._recent if row[1] >= self._row[1] - BEFORE_NS)
            segment.states.append(self._row)
        self._windows[stretch].begin(segment)

    def _observed(self, index: int, t_ns: int, o: Observation) -> None:
        last_seq, last_ns = self._last
        if self._anew or (o.seq < last_seq and o.stamp_ns < last_ns):  # both go back: the robot was started anew
            self._anew = False
            self._stamps.clear()
            self._recent.clear()
            for window in self._windows.values():
                if window.open:
                    window.begin(_Segment(self._run, ()))
        elif o.stamp_ns <= last_ns:
            return
        self._last = o.seq, o.stamp_ns
        self._stamps[o.seq] = o.stamp_ns, t_ns
        if len(self._stamps) > ANSWERABLE:
            del self._stamps[next(iter(self._stamps))]
        self._row = (index, o.stamp_ns, o.x)
        for window in self._windows.values():
            window.state(*self._row)


def log_identity(run: str, public_key: bytes) -> str:
    """Stands for a whole run's log, whatever is still written to it: what a model fitted on its driving remembers (guarantee G6)."""
    return digest(f"s2r log {run} {public_key.hex()}".encode())
