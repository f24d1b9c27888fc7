"""Asks controllers again about all that they drove on, one state at a time, confined, in the order of the log (`--rerun-controllers`).

The scenarios are drawn again from the run's seed, as the daemon's process drew them. The same controller must propose the same inputs, but
for TOLERANCE of the largest. A controller that had another face on the robot is seen here, whatever it did when it was verified.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from s2r_runtime.controllers.batches import BatchController
from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.controllers.observing import view_of
from s2r_runtime.controllers.rehearsal import TOLERANCE
from s2r_runtime.errors import S2RError
from s2r_runtime.plugins import registry

if TYPE_CHECKING:
    from s2r_runtime.audit.findings import Findings
    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.messages import Observation, Proposed, Scenarios
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import TaskChoice
    from s2r_runtime.recording.reading import Entry

KEPT = 1000
"""Observations that an answer may lag behind."""
WITHIN_S = 30.0
"""For its start and for each answer: a controller that answered in time on the robot and never here would hold up the audit for good."""


class DrivenAgain:
    """Of one run: at most one controller at a time."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._control: BatchController | None = None
        self._seen: dict[int, tuple[float, ...]] = {}
        self._largest = 0.0

    def start(self, file: ControllerFile | None, model: ComposedModel, choice: TaskChoice, scenarios: Scenarios) -> None:
        """A controller starts, in these scenarios of the task."""
        self.stop()
        if file is None:
            self._findings.cannot("what a controller drove: it is not attached")
            return
        task = registry().get("tasks", choice.name)(choice.parameters, model.nominal, model.dt)
        self._largest, self._episodes = 0.0, Episodes.of(task, scenarios)
        try:
            self._view = view_of(file, model)
            self._control = BatchController(file, len(model.inputs), within_s=WITHIN_S)
        except (S2RError, OSError) as error:
            self._findings.cannot(f"what a controller drove: {error}")

    def observed(self, observation: Observation) -> None:
        """The robot was seen there."""
        self._seen[observation.seq] = observation.x
        if len(self._seen) > KEPT:
            del self._seen[next(iter(self._seen))]

    def proposed(self, entry: Entry, event: Proposed) -> None:
        """The controller's answer, which is to be that of the same controller here."""
        x, u = self._seen.get(event.command.obs_seq), np.array(event.command.u)
        if self._control is None or x is None:
            return
        try:
            theta, episode, _ = self._episodes.look(np.array(x))
        except Exception as error:  # noqa: BLE001 - a third party's task
            self._findings.cannot(f"what a controller drove: task: {type(error).__name__}: {error}")
            self.stop()
            return
        try:
            state = np.array([x])
            again = self._control(state, self._view(state, theta or {}, first=episode.k == 0))[0]
        except S2RError as error:
            self._findings.differ(entry.index, entry.channel, f"the controller gives no answer here: {error}", event, None)
            self.stop()
            return
        self._largest = max(self._largest, float(np.max(np.abs(u), initial=0.0)))
        if again.shape != u.shape or not np.all(np.abs(again - u) <= TOLERANCE * self._largest):
            told = "the controller answers otherwise than it drove"
            self._findings.differ(entry.index, entry.channel, told, event, again.tolist())
            self.stop()
            return
        self._findings.count("driving commands that their controller gives again")

    def lost_track(self) -> None:
        """An answer came too late to be logged, so what the controller was shown next is not known for certain."""
        if self._control is not None:
            self._findings.count("drives not asked again beyond an answer that was late")
            self.stop()

    def stop(self) -> None:
        """It drives no more. May be called twice."""
        if self._control is not None:
            self._control.close()
            self._control = None
