"""Closed-loop runs of a controller on the robot, taken from its logs, and what they show (guarantee G9).

    n runs, k of them unsafe       P(unsafe) <= p,  P(Bin(n, p) <= k) = beta               (Clopper-Pearson)
    d_i the largest discrepancy    a new run's exceeds max_i d_i with probability at most
    over run i                     1 - beta^(1/n)                                           (G1, with a run as the sample)

each with confidence 1 - beta, if the runs are independent draws of one law. Everything is judged from the log: a scenario is drawn again
from the run's seed, its safety recomputed from the observations; the controller's own word counts for nothing.

A run is a scenario of a deployment. It is left out, whatever came of it, where the controller met the same scenario before (an earlier
deployment had the same seed), be it that that run was left out itself. It counts as unsafe where the controller failed in it, where the
gate closed in it or refused its first command, or where it scores below the profile's threshold. It is left out where it began while the
gate had not opened yet, and where a person or the log's end cut it short, no recovery command sent, while it was not below the threshold.

Logs are taken in the order of their own start times, so that the first n runs are the same however the files are given.

The daemon counts runs by itself as well, all of them, with limits that hold after every run (guarantee G10, `core.runs`): `newest_limits`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_field

from s2r_runtime import messages as m
from s2r_runtime.controllers.episodes import Episode, Episodes
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.scores import Score
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
    "out/model_adopted",
    "out/ask",
    "out/send",
)
SCORES = ("safe", "safety", "progress")
"""By what a run may be scored: whether it was safe, the task's safety value, or its progress."""
KEPT = 1000
"""Observations that an answer may lag behind."""


@dataclass
class Run:
    """One scenario. first, last: numbers of its first and last observation; driven: by the controller from the first step on; closed: the
    gate closed in it or refused its first command, or the controller failed in it; over: it came to its own end. seed, start: those from
    which its scenario is drawn again (`Episodes`), the start (nx,) as observed. progress: the task's, at its end. states: (nx,) each,
    if they are wanted, the one at which it ended too; inputs: what the controller answered to each but that one (nu,), None: nothing.
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
    states: list[tuple[float, ...]] = field(default_factory=list)
    inputs: list[tuple[float, ...] | None] = field(default_factory=list)


@dataclass
class _Deployment:
    """A controller under way. asked: about which observation; looked: at which of them, since it was asked; open: the gate is; settled: the
    gate was open when the controller was asked.
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


@dataclass
class Found:
    """Runs that count, with whether each was safe; left_out: why -> how many; heads: of the logs' chains."""

    counted: list[tuple[Run, bool]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    heads: list[str] = field(default_factory=list)


def read_runs(
    paths: Sequence[Path], profile: Profile, task: Task, controller_digest: str, model_digest: str, *, with_states: bool = False
) -> Found:
    """Runs of this controller in these logs, in the order of the logs' start times, however they are given. model_digest: empty, if it does
    not matter against which model they were measured. with_states: the states of each run, too, which takes memory.

    Raises ConfigError for a log of another robot, task or profile.
    """
    found, used, threshold = Found(), set[tuple[int, int]](), profile.verification.threshold
    for parts in in_order(paths):
        for deployment in deployments(parts, profile, task, with_states=with_states):
            for run in _judged(deployment):
                reason = _left_out(run, deployment, controller_digest, model_digest, used, threshold)
                if reason:
                    found.left_out[reason] = found.left_out.get(reason, 0) + 1
                else:
                    found.counted.append((run, not run.closed and run.safety >= threshold))
        found.heads += [parts[-1].head.hex()]
    return found


def newest_limits(paths: Sequence[Path], controller_digest: str) -> m.RunLimits | None:
    """What the daemon counted of this controller's runs until the end of these logs (guarantee G10); None where it counted none."""
    found: m.RunLimits | None = None
    for parts in sorted(logged_runs(paths, ("event/started", "out/episode_counted")), key=_began):
        for entry in (entry for reading in parts for entry in reading):
            message: Any = entry.message
            if isinstance(message, m.EpisodeCounted) and message.controller == controller_digest and message.limits:
                found = message.limits[0]
    return found


def values_of(found: Found, score: Score) -> list[float]:
    """What each run that counts scores by `safe`, `safety` or `progress`; the worst value where the gate closed in it or the controller
    failed. Raises UsageError for another name.
    """
    if score.name not in SCORES:
        raise UsageError(f"the score {score.name!r} is not known, must be one of: {', '.join(SCORES)}")
    values = []
    for run, safe in found.counted:
        if score.name == "safe":
            values.append(float(safe))
        elif run.closed:
            values.append(score.worst)
        else:
            values.append(run.safety if score.name == "safety" else math.nan if run.progress is None else run.progress)
    return values


def in_order(paths: Sequence[Path]) -> list[list[Reading]]:
    """The logs of each run of the daemon, in the order in which these began."""
    return sorted(logged_runs(paths, CHANNELS), key=_began)


def _began(parts: Sequence[Reading]) -> tuple[float, str]:
    """When a run of the daemon began, s since 1970, and its name, which settles ties. A log without its beginning comes last: nothing in it
    can be judged.
    """
    for entry in Reading(parts[0].path, ("event/started",)):
        message: Any = entry.message
        return float(message.unix_s), parts[0].run
    return math.inf, parts[0].run


def _left_out(run: Run, deployment: _Deployment, controller: str, model: str, used: set[tuple[int, int]], threshold: float) -> str:
    """Why this run does not count, or empty. used: the scenarios that this controller has met; this one is added."""
    if deployment.digest != controller:
        return "of another controller"
    scenario = (deployment.seed, run.index)
    if scenario in used:
        return "the same scenario as an earlier run (same seed)"
    used.add(scenario)
    if model and deployment.model_digest != model:
        return "measured against another model"
    if run.closed:
        return ""
    if not run.driven:
        return "not driven by the controller from its start"
    return "cut short by a person or the end of the log, safe so far" if not run.over and run.safety >= threshold else ""


def _judged(deployment: _Deployment) -> Iterator[Run]:
    """The runs, each with its largest discrepancy (of transitions that end after its first observation)."""
    measured = sorted(deployment.measured)
    at = 0
    for run in deployment.runs:
        while at < len(measured) and measured[at][0] <= run.last:
            if measured[at][0] > run.first:
                run.discrepancy = max(run.discrepancy, measured[at][1])
            at += 1
        yield run


def deployments(parts: Iterable[Reading], profile: Profile, task: Task, *, with_states: bool) -> Iterator[_Deployment]:
    """Controllers in one run of the daemon, message by message.

    Raises ConfigError for a log of another robot, task or profile, and for a damaged one.
    """
    settings: m.Settings | None = None
    model, seen, now = "", dict[int, tuple[float, ...]](), None
    for reading in parts:
        for entry in reading:
            message: Any = entry.message
            match message:
                case m.Started():
                    settings = message.settings
                    _check(settings, profile, reading.path)
                    model = message.memory.model_digest or settings.model_digest
                case m.ModelAdopted():
                    model = message.digest
                case m.Observed():
                    seen[message.observation.seq] = message.observation.x
                    while len(seen) > KEPT:
                        del seen[next(iter(seen))]
                case m.StartController() if settings is not None:
                    if now is not None:
                        yield now
                    episodes = Episodes(task, settings.seed, profile.task.episodes)
                    now = _Deployment(message.digest, settings.seed, model, episodes, with_states=with_states)
                case _ if now is not None:
                    now = _within(now, message, seen)
        if reading.ending.kind == "broken":
            raise ConfigError(f"{reading.path}: is damaged ({reading.ending.detail}); runs are taken from logs that hold")
    if now is not None:
        yield now


def _within(now: _Deployment, message: Any, seen: dict[int, tuple[float, ...]]) -> _Deployment:
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
    return now


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


def first(found: Found, n: int) -> Found:
    """The first n runs that count; all of them for 0."""
    return replace(found, counted=found.counted[:n] if n else found.counted)


def trials(found: Found, *, controller_digest: str, task_digest: str, model_digest: str, beta: float, fixed: int = 0) -> m.Trials:
    """What the runs show. fixed: how many were fixed beforehand: so many, the first, count (0: all that are there).

    Raises NotEnoughEvidence if there are none, or fewer than were fixed.
    """
    counted = first(found, fixed).counted
    if len(counted) < max(fixed, 1):
        raise NotEnoughEvidence(f"{len(counted)} runs of this controller count, {max(fixed, 1)} are needed", max(fixed, 1) - len(counted))
    n, unsafe = len(counted), sum(not safe for _, safe in counted)
    return m.Trials(
        n=n,
        unsafe=unsafe,
        unsafe_upper=float(clopper_pearson_upper(unsafe, n, beta)),
        worst=max(min(run.safety for run, _ in counted), -float(np.finfo(np.float64).max)),
        radius=max(run.discrepancy for run, _ in counted),
        epsilon=-math.expm1(math.log(beta) / n),
        beta=beta,
        fixed=bool(fixed),
        left_out=found.left_out,
        logs=tuple(found.heads),
        controller_digest=controller_digest,
        task_digest=task_digest,
        model_digest=model_digest,
    )
