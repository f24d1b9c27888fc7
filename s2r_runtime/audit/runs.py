"""Recomputes how each run went from the observations: a log from which an episode is missing, or into which one was put, is found (G10).

The scenarios are drawn again from the run's seed. The daemon's process takes one step of the task for each question that it answers, and
reports the scenario's end (`EpisodeEnded`) and each crossing of the threshold (`EpisodeScored`) before that answer. So between two answers
exactly these reports must be in the log. Which run that makes, and the limits, follow in the core, which is run again anyway.

After an answer that was too late (`AnswerLate`) the log does not say which questions were answered. Then the reports of that deployment are
not checked any more, and the audit says so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from s2r_runtime.audit.findings import Findings, alike
from s2r_runtime.controllers.episodes import Episodes, end_report, score_report
from s2r_runtime.messages import EpisodeEnded, EpisodeScored
from s2r_runtime.plugins import registry

if TYPE_CHECKING:
    from s2r_runtime.messages import Observation, Scenarios, SourceStopped
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile
    from s2r_runtime.recording.reading import Entry

KEPT = 1000
"""Observations that an answer may lag behind."""


class RunsReplay:
    """Of one run of the daemon: at most one controller at a time."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._episodes: Episodes | None = None
        self._threshold = 0.0
        self._scored: tuple[int, bool] = (-1, False)
        self._seen: dict[int, tuple[float, ...]] = {}
        self._shown: int | None = None
        self._reported: list[tuple[Entry, EpisodeEnded | EpisodeScored]] = []

    def start(self, model: ComposedModel | None, profile: Profile, scenarios: Scenarios) -> None:
        """A controller starts, in these scenarios of the task."""
        self._reported, self._shown, self._scored = [], None, (-1, False)
        self._episodes = None
        if model is None:
            self._findings.cannot("how the runs of a controller went: its model does not run here")
            return
        task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
        self._episodes = Episodes.of(task, scenarios)
        self._threshold = profile.verification.threshold

    def observed(self, observation: Observation) -> None:
        """The robot was seen there."""
        self._seen[observation.seq] = observation.x
        if len(self._seen) > KEPT:
            del self._seen[next(iter(self._seen))]

    def shown(self, obs_seq: int) -> None:
        """The controller is to be shown this observation."""
        self._shown = obs_seq

    def reported(self, entry: Entry, event: EpisodeEnded | EpisodeScored) -> None:
        """A report is recorded; it belongs to the answer that follows."""
        self._reported.append((entry, event))

    def answered(self, entry: Entry, obs_seq: int) -> None:
        """The controller's answer is recorded."""
        self._compare(entry, obs_seq, whole=True)

    def late(self) -> None:
        """An answer came after its deadline, so what the controller was shown next is not known for certain."""
        if self._episodes is not None:
            self._findings.count("deployments whose runs are not checked beyond a delayed answer")
            self._episodes, self._reported = None, []

    def gone(self, entry: Entry, event: SourceStopped) -> None:
        """The controller's process ended by itself. Where all scenarios are over, the last one's end was reported before."""
        if event.reason == "finished" or self._reported:
            self._compare(entry, self._shown, whole=event.reason == "finished")
        self._episodes, self._reported = None, []

    def stop(self, entry: Entry) -> None:
        """It is stopped, perhaps by what a report led to."""
        if self._reported:
            self._compare(entry, self._shown, whole=False)
        self._episodes, self._reported = None, []

    def _compare(self, entry: Entry, obs_seq: int | None, *, whole: bool) -> None:
        """Holds the reports since the last answer against those of this observation. whole: all of them must be there."""
        reported, self._reported = self._reported, []
        if self._episodes is None:
            return
        x = None if obs_seq is None else self._seen.get(obs_seq)
        due = [] if x is None else self._reports(x)
        for index in range(max(len(due) if whole else 0, len(reported))):
            recorded = reported[index] if index < len(reported) else None
            expected = due[index] if index < len(due) else None
            if recorded is None or expected is None or not _same(recorded[1], expected):
                where, found = (entry, None) if recorded is None else recorded
                what = "what a run came to is not what the observations make of it" if found is not None else "a run's end is not recorded"
                self._findings.differ(where.index, where.channel, what, found, expected)
                self._episodes = None
                return
            if isinstance(expected, EpisodeEnded):
                self._findings.count("runs")

    def _reports(self, x: tuple[float, ...]) -> list[EpisodeEnded | EpisodeScored]:
        """What the daemon's process reports of this observation."""
        assert self._episodes is not None  # noqa: S101 - the caller checked
        try:
            seen, now, over = self._episodes.look(np.array(x))
        except Exception as error:  # noqa: BLE001 - a third party's task
            self._findings.cannot(f"how the runs of a controller went: task: {type(error).__name__}: {error}")
            return []
        found: list[EpisodeEnded | EpisodeScored] = [] if over is None else [end_report(0, over)]
        if seen is not None:
            self._scored, score = score_report(0, now, self._scored, self._threshold)
            found += [] if score is None else [score]
        return found


def _same(recorded: EpisodeEnded | EpisodeScored, expected: EpisodeEnded | EpisodeScored) -> bool:
    return type(recorded) is type(expected) and alike(msgspec.structs.replace(recorded, t_ns=0), expected)
