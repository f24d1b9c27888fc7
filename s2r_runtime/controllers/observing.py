"""What a controller is shown of state and scenario. A learned policy sees the observations that its settings list, with their history.

A file in Python sees the scenario as the task shows it. For a policy, each observation is an array (n, history, width): the oldest first,
the newest last. At the start of a scenario the history is filled with the first observation. It is held here, outside of the
controller's process, so that the controller stays a function of its arguments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from s2r_runtime.controllers.policy import is_policy, settings_of
from s2r_runtime.errors import ConfigError, ControllerError
from s2r_runtime.hookspecs import Scenario

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.controllers.policy import Observed, Settings

    Array = NDArray[np.float64]


class View(Protocol):
    """x (n, nx) and the task's view of n scenarios -> `theta` for the controller. first: these scenarios begin here."""

    def __call__(self, x: Array, theta: Scenario, *, first: bool) -> Scenario:
        """Call it once a step, in order."""
        ...


class Named(Protocol):
    """A model's names."""

    @property
    def states(self) -> tuple[str, ...]:
        """Of x."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Of u."""
        ...


def whole(x: Array, theta: Scenario, *, first: bool) -> Scenario:
    """All that the task shows."""
    return theta


def view_of(file: ControllerFile, model: Named) -> View:
    """What this controller is shown. Raises ConfigError for a policy whose outputs are not the model's inputs."""
    if not is_policy(file.entry):
        return whole
    settings = settings_of(file.entry, file.parameters)
    outputs = tuple(output.name for output in settings.outputs)
    if outputs != model.inputs:
        raise ConfigError(
            f"{file.path}: its outputs are {', '.join(outputs)}; must be the robot's inputs in order: {', '.join(model.inputs)}"
        )
    return Observations(file.path, settings, model.states)


def has_history(file: ControllerFile) -> bool:
    """Whether this controller is shown more than the present observation."""
    return is_policy(file.entry) and settings_of(file.entry, file.parameters).history > 1


class Observations:
    """The observations of a policy, by name. One object for one batch of scenarios at a time."""

    def __init__(self, path: str, settings: Settings, states: tuple[str, ...]) -> None:
        self._path, self._settings, self._states = path, settings, states
        self._seen: dict[str, Array] = {}

    def __call__(self, x: Array, theta: Scenario, *, first: bool) -> Scenario:
        """As `View`. Raises ConfigError for a name that neither the robot nor the scenario has, or a scale of the wrong length."""
        import numpy as np

        now = {one.name: self._value(one, x, theta)[:, None, :] for one in self._settings.observations}
        if first or not self._seen:
            self._seen = {name: np.repeat(value, self._settings.history, axis=1) for name, value in now.items()}
            return self._seen
        if any(self._seen[name].shape[::2] != value.shape[::2] for name, value in now.items()):
            raise ControllerError(f"{self._path}: an observation changed its shape within a scenario")
        self._seen = {name: np.concatenate([self._seen[name][:, 1:], value], axis=1) for name, value in now.items()}
        return self._seen

    def _value(self, one: Observed, x: Array, theta: Scenario) -> Array:
        """(n, width), float64; an array of the scenario in the order of its elements."""
        import numpy as np

        if one.name in self._states:
            column = self._states.index(one.name)
            value: Any = x[:, column : column + 1]
        elif one.name in theta:
            value = np.asarray(theta[one.name])
        else:
            scenario = f"; the scenario's values: {', '.join(sorted(theta))}" if theta else ""
            raise ConfigError(
                f"{self._path}: observation {one.name!r} is not known; the robot's states: {', '.join(self._states)}{scenario}"
            )
        value = np.ascontiguousarray(value, dtype=np.float64).reshape(len(x), -1)
        for what, numbers in (("offset", one.offset), ("scale", one.scale)):
            if isinstance(numbers, tuple) and len(numbers) != value.shape[1]:
                raise ConfigError(
                    f"{self._path}: observation {one.name!r}: {what} has {len(numbers)} numbers, must be one, or {value.shape[1]}"
                )
        return np.array(value)
