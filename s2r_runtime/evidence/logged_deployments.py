"""Deployments of controllers in a daemon's logs, scenario by scenario: what a controller was shown, what drove, and how it ended.

Everything is judged from the log: a scenario is drawn again from the run's seed, its safety recomputed from the observations; the
controller's own word counts for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_field

from s2r_runtime import messages as m
from s2r_runtime.controllers.episodes import Episode, Episodes
from s2r_runtime.core.runs import counted as counts_runs
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.hookspecs import Task
from s2r_runtime.profile import Profile
from s2r_runtime.recording.logs import runs as logged_runs
from s2r_runtime.recording.reading import Reading

CHANNELS = (
    "event/started",
    "event/observed",
    "event/proposed",
    "event/measured",
    "event/source_stopped",
    "out/gate_changed",
    "out/decided",
    "out/start_controller",
    "out/stop_controller",
    "out/episode_counted",
    "out/model_adopted",
    "out/ask",
    "out/send",
)
KEPT = 1000
"""Observations that an answer may lag behind."""


@dataclass
class Run:
    """One scenario. first, last: numbers of its first and last observation; driven: by the controller from the first step on; closed: the
    gate closed in it or refused its first command, or the controller failed in it; over: it came to its own end. seed, start: those from
    which its scenario is drawn again (`Episodes`), the start (nx,) as observed. progress: the task's, at its end. outcome: what the daemon
    counted it as (`core.runs`), if it did. states: (nx,) each, if they are wanted, the one at which it ended too; inputs: what the
    controller answered to each but that one (nu,), None: nothing.
    """

    index: int
    first: int
    last: int = -1
    safety: float = math.inf
    driven: bool | None = None
    closed: bool = False
    over: bool = False
    discrepancy: float = 0.0
    seed: int = 0
    start: tuple[float, ...] = ()
    progress: float | None = None
    outcome: str = ""
    states: list[tuple[float, ...]] = field(default_factory=list)
    inputs: list[tuple[float, ...] | None] = field(default_factory=list)


@dataclass
class Deployment:
    """A controller under way. asked: about which observation; looked: at which of them, since it was asked; open: the gate is; settled: the
    gate was open when the controller was asked. ended: the daemon stopped it, or it ended by itself. counted: the daemon counts runs.
    scenarios: of a comparison.
    """

    digest: str
    seed: int
    model_digest: str
    episodes: Episodes
    runs: list[Run] = field(default_factory=list)
    measured: list[tuple[int, float]] = field(default_factory=list)
    asked: int | None = None
    looked: int | None = None
    open: bool = False
    settled: bool = False
    ended: bool = False
    counted: bool = False
    scenarios: m.Scenarios | None = None
    with_states: bool = False

    def ask(self, seq: int) -> None:
        """The controller is asked about this."""
        self.asked, self.looked, self.settled = seq, None, self.open

    def look_at_asked(self, seen: dict[int, tuple[float, ...]]) -> None:
        """What the controller was asked about and has not answered: a scenario may have ended or begun there all the same."""
        if self.asked is not None and self.asked in seen:
            self.look(self.asked, seen[self.asked])

    def look(self, seq: int, x: tuple[float, ...]) -> None:
        """The controller was shown this. Once a question: its answer may come after somebody else's command."""
        if seq == self.looked:
            return
        self.looked, self.asked = seq, None
        try:
            seen, now, ended = self.episodes.look(np.array(x))
        except NotEnoughEvidence:  # no scenario begins there: the controller was not asked on
            return
        if ended is not None:
            self._note(ended, seq)
            self.runs[-1].over = True
            if self.with_states:
                self.runs[-1].states.append(x)
        if seen is None:
            return
        if not self.runs or self.runs[-1].index != now.index:
            self.runs.append(Run(now.index, seq, seed=self.seed, start=x))
        self._note(now, seq)
        if self.with_states:
            self.runs[-1].states.append(x)
            self.runs[-1].inputs.append(None)

    def answer(self, seq: int, u: tuple[float, ...]) -> None:
        """The controller's answer to what it was shown."""
        if self.runs and self.runs[-1].inputs and not self.runs[-1].over and self.runs[-1].last == seq:
            self.runs[-1].inputs[-1] = u

    def _note(self, episode: Episode, seq: int) -> None:
        run = self.runs[-1]
        run.last, run.safety = seq, -math.inf if episode.safety is None else episode.safety
        run.progress = episode.progress

    def sent(self, send: m.Send) -> None:
        """The robot was told something, by somebody."""
        if not self.runs or self.runs[-1].over:
            return
        run, mine = self.runs[-1], send.source == "controller"
        if run.driven is None:
            run.driven = mine
            run.closed |= not mine and self.settled
        elif not mine and run.driven:
            run.closed = True

    def failed(self) -> None:
        """The controller is gone, by its own fault."""
        if self.runs and not self.runs[-1].over:
            self.runs[-1].closed = True

    def refused(self) -> None:
        """The gate refused a command, for another reason than that it had not opened yet."""
        if self.runs and not self.runs[-1].over and self.runs[-1].driven is not False:
            self.runs[-1].closed = True


def read_deployments(
    paths: Sequence[Path], profile: Profile, task: Task, heads: list[str] | None = None, *, with_states: bool = False
) -> Iterator[Deployment]:
    """All deployments in these logs, in the order of the logs' start times. heads: takes those of the chains. Raises as `read_runs`."""
    for parts in in_order(paths):
        yield from deployments(parts, profile, task, with_states=with_states)
        if heads is not None:
            heads.append(parts[-1].head.hex())


def in_order(paths: Sequence[Path]) -> list[list[Reading]]:
    """The logs of each run of the daemon, in the order in which these began."""
    return sorted(logged_runs(paths, CHANNELS), key=began)


def began(parts: Sequence[Reading]) -> tuple[float, str]:
    """When a run of the daemon began, s since 1970, and its name, which settles ties. A log without its beginning comes last: nothing in it
    can be judged.
    """
    for entry in Reading(parts[0].path, ("event/started",)):
        message: Any = entry.message
        return float(message.unix_s), parts[0].run
    return math.inf, parts[0].run


def deployments(parts: Iterable[Reading], profile: Profile, task: Task, *, with_states: bool) -> Iterator[Deployment]:
    """Controllers in one run of the daemon, message by message.

    Raises ConfigError for a log of another robot, task or profile, and for a damaged one.
    """
    replay = Replay(profile, task, with_states=with_states)
    for reading in parts:
        for _ in replay.read(reading):
            yield from replay.deployments[:-1]
            del replay.deployments[:-1]
    yield from replay.deployments


class Replay:
    """One run of the daemon, message by message. deployments: so far, in order."""

    def __init__(self, profile: Profile, task: Task, *, with_states: bool = False) -> None:
        self._profile, self._task, self._with_states = profile, task, with_states
        self._settings: m.Settings | None = None
        self._model, self._seen = "", dict[int, tuple[float, ...]]()
        self.deployments: list[Deployment] = []

    def read(self, reading: Reading) -> Iterator[None]:
        """Takes what that part of its log holds, or holds since it was read last, a message a step. Raises as `deployments`."""
        for entry in reading:
            self._take(entry.message, reading.path)
            yield
        if reading.ending.kind == "broken":
            raise ConfigError(f"{reading.path}: is damaged ({reading.ending.detail}); runs are taken from logs that hold")

    def _take(self, message: Any, path: Path) -> None:
        match message:
            case m.Started():
                self._settings = message.settings
                _check(message.settings, self._profile, path)
                self._model = message.memory.model_digest or message.settings.model_digest
            case m.ModelAdopted():
                self._model = message.digest
            case m.Observed():
                self._seen[message.observation.seq] = message.observation.x
                while len(self._seen) > KEPT:
                    del self._seen[next(iter(self._seen))]
            case m.StartController() if self._settings is not None:
                of = message.scenarios or m.Scenarios(self._settings.seed, 0, self._profile.task.episodes)
                episodes = Episodes.of(self._task, of)
                now = Deployment(message.digest, of.seed, self._model, episodes, with_states=self._with_states)
                now.counted, now.scenarios = counts_runs(self._settings), message.scenarios
                self.deployments.append(now)
            case _ if self.deployments:
                _within(self.deployments[-1], message, self._seen)


def _within(now: Deployment, message: Any, seen: dict[int, tuple[float, ...]]) -> None:
    """What happens while a controller is under way."""
    match message:
        case m.Ask(source="controller", obs_seq=seq):
            now.ask(seq)
        case m.Proposed(command=command) if command.source == "controller" and command.obs_seq in seen:
            now.look(command.obs_seq, seen[command.obs_seq])
            now.answer(command.obs_seq, command.u)
        case m.SourceStopped(source="controller", reason=reason):
            if reason != "stopped":
                now.look_at_asked(seen)
            if reason not in {"finished", "stopped"}:
                now.failed()
            now.ended = True
        case m.GateChanged():
            now.open = message.open
        case m.Decided(source="controller", allow=False, reason=reason) if reason != "settling":
            now.refused()
        case m.Send():
            if message.source != "controller":
                now.look_at_asked(seen)
            now.sent(message)
        case m.Measured(fault="") if math.isfinite(message.discrepancy):
            now.measured.append((message.obs_seq, message.discrepancy))
        case m.StopController():
            now.ended = True
        case m.EpisodeCounted(controller=digest, index=index, outcome=outcome) if digest == now.digest:
            for run in now.runs:
                if run.index == index:
                    run.outcome = outcome


def _check(settings: m.Settings, profile: Profile, path: Path) -> None:
    for what, there, here in (
        ("robot", settings.robot, profile.robot.name),
        ("task", settings.task_digest, profile.task_digest()),
        ("profile", settings.profile_digest, profile.digest()),
    ):
        if what == "profile" and there in {one.digest() for one in (profile.by_text(), without_demand(profile), without_radius(profile))}:
            continue  # a log of an earlier version, or of before a limit was demanded or a radius fixed
        if there != here:
            raise ConfigError(f"{path}: its {what} is {there}, the profile's is {here}")


def without_demand(profile: Profile) -> Profile:
    """The profile before it demanded a limit of the model's optimism. Runs are driven and judged under it in the same way."""
    return replace_field(profile, verification=replace_field(profile.verification, max_optimism=1.0))


def without_radius(profile: Profile) -> Profile:
    """The profile before it fixed a radius of the runs' residuals (guarantee G13), and demanded anything."""
    demanded = without_demand(profile)
    return replace_field(demanded, verification=replace_field(demanded.verification, run_radius=0.0))
