"""What follows from a log by its model and task: the residual by state, and the scenario that the controller is in.

    residual = measured x one step later  -  model step of x and u          (nx,), angles wrapped; SI, rad

Both are drawn again from what the log has, as the daemon's processes had it. A model that is a Python file does not run here: then there is
neither.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from s2r_runtime import messages as m
from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.errors import S2RError, one_line
from s2r_runtime.evidence.comparison import EARLY
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import parse_model
from s2r_runtime.plugins import registry
from s2r_runtime.profile import parse_profile

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from s2r_runtime.hookspecs import Scenario
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile

    Array = NDArray[np.float64]

KEPT = 1000
"""Observations that an answer may lag behind."""
LONGEST_HOLD = 200
"""Periods for which a held input is carried into the effects' memory."""


class Simulation:
    """`take` every message, in order. attached: the log's files, by name. `residual`, `view`: the newest, or None. `trouble`: why
    one of them cannot be there, in a line, or empty.
    """

    def __init__(self, attached: Mapping[str, bytes], folder: Path) -> None:
        self._attached, self._folder = attached, folder
        self.residual: Array | None = None
        self.view: Scenario | None = None
        self.trouble = ""
        self._model: ComposedModel | None = None
        self._profile: Profile | None = None
        self._settings: m.Settings | None = None
        self._episodes: Episodes | None = None
        self._seen: dict[int, m.Observation] = {}
        self._rest()

    def begin(self, settings: m.Settings, model_digest: str) -> None:
        """A run, or where it is looked at from. model_digest: of the model in force."""
        self._settings, self.trouble = settings, ""
        self._episodes, self.view = None, None
        self._seen.clear()
        self._use(model_digest)

    def take(self, message: m.Struct) -> None:
        """The next message of the log. Nothing that it holds raises here."""
        if self._model is None:
            if isinstance(message, m.ModelAdopted):
                self._use(message.digest)
            return
        match message:
            case m.Observed(observation=observation) if not observation.fault:
                self._observed(observation, self._model)
            case m.Send():
                self._sent(message, self._model)
            case m.LinkChanged():
                self._rest()
            case m.StartController():
                self._start(self._model)
            case m.Proposed(command=command) if command.source == "controller":
                self._answered(command.obs_seq)
            case m.AnswerLate() | m.StopController() | m.SourceStopped(source="controller"):
                self._episodes, self.view = None, None
            case m.ModelAdopted(digest=digest):
                self._use(digest)
            case _:
                pass

    def _use(self, digest: str) -> None:
        """The model of this digest, which the log has attached."""
        self._model = None
        try:
            for name, data in self._attached.items():
                if name == "model.toml" or name.startswith("model/"):
                    spec = parse_model(data.decode(), ".", name)
                    if spec.digest() == digest and not spec.name.endswith(".py"):
                        self._model = compose(spec)
                    elif spec.digest() == digest:
                        self.trouble = f"the model is the Python file {spec.name}, which does not run here: no residual, no scenario"
            self._profile = parse_profile(self._attached["profile.toml"].decode(), "profile.toml", self._folder, self._files())
        except (S2RError, KeyError, ValueError) as error:
            self.trouble = f"no residual, no scenario: {one_line(str(error))}"
        self._rest()

    def _files(self) -> dict[str, str]:
        return {name.removeprefix("profile/"): data.decode() for name, data in self._attached.items() if name.startswith("profile/")}

    # ---- residual

    def _rest(self) -> None:
        self._hidden = None if self._model is None else self._model.at_rest(1)
        self._open: tuple[m.Observation, m.Send] | None = None
        self._last: m.Observation | None = None
        self.residual = None

    def _observed(self, observation: m.Observation, model: ComposedModel) -> None:
        self.residual = None
        if self._last is not None and observation.stamp_ns <= self._last.stamp_ns:
            self._rest()
        self._last = observation
        self._seen[observation.seq] = observation
        if len(self._seen) > KEPT:
            del self._seen[next(iter(self._seen))]
        if self._open is None or self._hidden is None:
            return
        before, send = self._open
        periods = (observation.stamp_ns - before.stamp_ns) * 1e-9 / model.dt
        if periods < 1.0 - EARLY:
            return  # observations come faster than commands
        self._open = None
        u = np.array([send.u])
        predicted, hidden = model.step(np.array([before.x]), u, self._hidden)
        if periods <= 1.0 + EARLY:
            self.residual = model.difference(np.array([observation.x]), predicted)[0]
        for _ in range(min(round(periods) - 1, LONGEST_HOLD)):
            _, _, hidden = model.act(u, hidden)
        self._hidden = hidden

    def _sent(self, send: m.Send, model: ComposedModel) -> None:
        if self._last is not None and send.obs_seq == self._last.seq and len(send.u) == len(model.inputs):
            self._open = (self._last, send)

    # ---- scenario

    def _start(self, model: ComposedModel) -> None:
        self._episodes, self.view = None, None
        profile, settings = self._profile, self._settings
        if profile is None or settings is None:
            return
        try:
            task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
        except S2RError as error:
            self.trouble = f"no scenario: {one_line(str(error))}"
        else:
            self._episodes = Episodes(task, settings.seed, profile.task.episodes)

    def _answered(self, obs_seq: int) -> None:
        if self._episodes is None or (seen := self._seen.get(obs_seq)) is None:
            return
        try:
            self.view, _, _ = self._episodes.look(np.array(seen.x))
        except Exception as error:  # noqa: BLE001 - a third party's task, on a log of anybody's
            self.trouble = f"no scenario: the task {type(error).__name__}: {one_line(str(error))}"
            self._episodes, self.view = None, None
