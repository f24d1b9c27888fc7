"""Models, profiles and controllers, as the command line and Python name them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2r_runtime.api.options import check_named_numbers, check_numbers
from s2r_runtime.api.results import Result
from s2r_runtime.api.spelling import front_door
from s2r_runtime.errors import ConfigError, UsageError
from s2r_runtime.files.canonical import digest
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.composed import ComposedModel, compose, resolve_source
from s2r_runtime.models.file_model import model_of
from s2r_runtime.modelspec import ModelSpec, dump_model, load_model
from s2r_runtime.profile import Profile, check_names, load_profile
from s2r_runtime.profile.checks import HEAVIEST, LIGHTEST

if TYPE_CHECKING:
    from s2r_runtime.controllers.file import ControllerFile

Array = NDArray[np.float64]
FUNCTION = "function "
"""Begins the name of a model that is a function."""


@dataclass(frozen=True, eq=False, repr=False)
class Model(Result):
    """A nominal model with its effects. Batched: x is (n, nx), u is (n, nu), in SI units; angles in rad."""

    composed: ComposedModel
    """For the functions of this package."""
    comments: tuple[str, ...] = ()
    """Lines at the head of a saved file."""
    function: NominalModel | None = None
    """Of a model that is a function."""

    @property
    def name(self) -> str:
        """Of the built-in model, or the path of its file."""
        return self.composed.spec.name

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the nx states, in order."""
        return self.composed.states

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the nu inputs, in order."""
        return self.composed.inputs

    @property
    def dt(self) -> float:
        """Step, s."""
        return self.composed.dt

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the nominal model's parameters, in SI units."""
        return dict(self.composed.parameters)

    @property
    def effects(self) -> tuple[dict[str, Any], ...]:
        """Effects in order: `name`, `channel`, `parameters`."""
        return tuple(msgspec.to_builtins(self.composed.spec.effects))

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        """States (n, nx) one step after x (n, nx) under inputs u (n, nu), which were zero before. Angles are wrapped to (-pi, pi]."""
        x, u = self._checked("x", x, self.states), self._checked("u", u, self.inputs)
        if len(x) != len(u):
            raise UsageError(f"step: x has {len(x)} rows, u has {len(u)}; must be equal")
        return self.composed.step(x.copy(), u, self.composed.at_rest(len(x)))[0]

    def rollout(self, x0: ArrayLike, u: ArrayLike) -> Array:
        """States (m + 1, nx) from x0 (nx,) on, under inputs u (m, nu), one a step."""
        u = self._checked("u", u, self.inputs)
        if np.shape(x0) != (len(self.states),):
            raise UsageError(f"rollout: x0 has the shape {np.shape(x0)}, must be ({len(self.states)},): {', '.join(self.states)}")
        x = self._checked("x0", np.asarray(x0)[None, :], self.states)
        hidden, found = self.composed.at_rest(1), [x[0]]
        for inputs in u:
            x, hidden = self.composed.step(x.copy(), inputs[None, :], hidden)
            found.append(x[0])
        return np.array(found)

    def summary(self) -> str:
        """Its name, states, inputs, parameters and effects."""
        numbers = ", ".join(f"{name} {value:g}" for name, value in self.parameters.items()) or "none"
        lines = [f"model {self.name}, step {self.dt:g} s"]
        lines += [f"states      {', '.join(self.states)}", f"inputs      {', '.join(self.inputs)}", f"parameters  {numbers}"]
        for effect in self.composed.spec.effects:
            values = ", ".join(f"{name} {value}" for name, value in effect.parameters.items())
            lines.append(f"effect      {effect.name} on {effect.channel}: {values}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: as in a model TOML, with `states` and `inputs`."""
        spec: dict[str, Any] = msgspec.to_builtins(self.composed.spec)
        return {**spec, "parameters": self.parameters, "states": list(self.states), "inputs": list(self.inputs)}

    def to_toml(self) -> str:
        """The text of a model file, which `s2r.model`, a profile and the command line read. Raises UsageError for a function."""
        if self.function is not None:
            raise UsageError(
                f"{self.name}: lives in this process only; write it to a Python file with STATES, INPUTS, PARAMS and step, "
                "and use s2r.model(FILE.py, dt=...)"
            )
        return dump_model(self.composed.spec, self.comments)

    def save(self, path: Path | str) -> Path:
        """Writes `to_toml()`. Raises UsageError where no file can be written."""
        return write_text(path, self.to_toml())

    def _checked(self, what: str, given: ArrayLike, names: Sequence[str]) -> Array:
        try:
            table = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{what}: must be a table of numbers, (n, {len(names)}): {', '.join(names)}") from None
        if table.ndim != 2 or table.shape[1] != len(names):
            raise UsageError(f"{what} has the shape {table.shape}, must be (n, {len(names)}): {', '.join(names)}")
        return table


ModelLike = str | Path | Model
ProfileLike = str | Path | Profile


class Chosen(NamedTuple):
    """A model, and the profile if one was given. own: the nominal model of a function."""

    model: ComposedModel
    profile: Profile | None
    own: NominalModel | None = None


@front_door
def model(
    source: str | Path | Model | Callable[..., Any] | None = None,
    *,
    profile: ProfileLike | None = None,
    dt: float | None = None,
    param: Mapping[str, float] | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    angles: Sequence[str] = (),
    rates: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Model:
    """A nominal model: built in, of a file, of a profile, or a function.

    source: a built-in name (`"unicycle"`), a Python file, a model TOML, or a function `step(x, u, dt, params)`: from x (n, nx), u (n, nu),
    dt in s and the dict `param` it computes x (n, nx) one step later. Without a source the profile's model is used.
    dt: step in s; needed with a name, a Python file or a function. param: values by name, in SI units.

    Of a function only: states, inputs: names in the order of the columns; angles: states that wrap; rates: state -> state whose rate it
    is; units: name -> SI unit. Such a model is known to this process only: it can be traced, and cannot be saved.

    Raises ConfigError (unknown name or parameter, a file with an error: which line), UsageError (dt is lacking or not > 0).
    """
    check_numbers(dt=dt)
    check_named_numbers(param=param)
    if callable(source) and not isinstance(source, Model):
        if states is None or inputs is None:
            raise UsageError("model: a function needs the names of its columns: states=(...), inputs=(...)")
        return _of_function(source, _needed_dt(dt), param or {}, states, inputs, angles, rates or {}, units or {})
    if states is not None or inputs is not None or angles or rates or units:
        raise UsageError("model: states, inputs, angles, rates and units belong to a function; a file or a name has its own")
    found = choose(source, profile, dt, param or {})
    return Model(found.model, function=found.own)


def choose(
    source: ModelLike | None, profile: ProfileLike | None = None, dt: float | None = None, param: Mapping[str, float] | None = None
) -> Chosen:
    """The model that is named, else the profile's. Raises UsageError or ConfigError."""
    if source is not None and not isinstance(source, str | Path | Model):
        raise TypeError(f"model: is {type(source).__name__}, must be a name, a path, or what s2r.model(...) gives")
    loaded = load_checked(profile) if profile is not None else None
    own = None
    if source is None:
        if loaded is None:
            raise UsageError("which model? give --profile P, or --model M --dt DT")
        spec, where = loaded.model, "the profile" if isinstance(profile, Profile) else str(profile)
    elif isinstance(source, Model):
        spec, where, own = source.composed.spec, "--model", source.function
    elif str(source).endswith(".toml"):
        spec, where = load_model(Path(source)), str(source)
    else:
        step = dt if dt is not None else loaded.model.dt if loaded else None
        if step is None:
            raise UsageError(f"--model {source} needs its step: --dt DT (s)")
        spec, where = _named(str(source), step), "--model"
    if dt is not None:
        spec = _with_dt(spec, dt)
    spec = resolve_source(spec, Path.cwd())
    if not param:
        return Chosen(compose(spec, where, own), loaded, own)
    try:
        changed = msgspec.structs.replace(spec, parameters={**spec.parameters, **param})
    except ValueError as error:
        raise UsageError(f"--param: {error}") from None
    try:
        return Chosen(compose(changed, where, own), loaded, own)
    except ConfigError as error:
        compose(spec, where, own)  # a model that is wrong without them too reports that itself
        raise UsageError(str(error).replace(f"{where}.parameters.", "--param ")) from None


def profile_model(source: ModelLike | None, profile: Profile, where: str) -> ComposedModel:
    """The profile's model, or a repaired one in its place. where: how messages call the profile.

    Raises ConfigError, and UsageError for a function: what verifies a controller runs in another process.
    """
    if isinstance(source, Model):
        if source.function is not None:
            raise UsageError(f"--model: {source.name} lives in this process only; write it to a Python file that the profile names")
        return source.composed
    if source is not None and not isinstance(source, str | Path):
        raise TypeError(f"model: is {type(source).__name__}, must be a path, or what s2r.model(...) gives")
    if source:
        return compose(load_model(Path(source)), str(source))
    return compose(profile.model, f"{where}: model")


def load_checked(profile: ProfileLike) -> Profile:
    """A profile whose names of models, states, tasks and transports were checked too. Raises ConfigError."""
    if isinstance(profile, Profile):
        return profile
    if not isinstance(profile, str | Path):
        raise TypeError(f"profile: is {type(profile).__name__}, must be a path")
    path = Path(profile)
    found = load_profile(path)
    check_names(found, str(path))
    return found


def controller_at(path: Path | str, param: Mapping[str, float]) -> ControllerFile:
    """The controller in that file. Raises UsageError if there is no such file, ConfigError if it is no controller."""
    from s2r_runtime.controllers import hosted as controllers

    path = Path(path)
    if not path.is_file():
        raise UsageError(
            f"{path}: no such file; a controller is a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
        )
    try:
        return controllers.load(path, dict(param))
    except ConfigError as error:
        if not param:
            raise
        controllers.load(path, {})  # a file that is wrong without them too reports that itself
        raise UsageError(f"--param: {error}") from None


def weights_of(states: tuple[str, ...], weight: Mapping[str, float], profile: Profile | None) -> tuple[float, ...]:
    """(nx,) weights: those given by state, else the profile's, else 1. Raises UsageError for an unknown state or a weight <= 0."""
    weights = dict(profile.norm.weights) if profile else {}
    for name, value in weight.items():
        if name not in states:
            raise UsageError(f"--weight {name}={value:g}: the model has no state {name!r}; it has: {', '.join(states)}")
        if not LIGHTEST <= value <= HEAVIEST:
            raise UsageError(f"--weight {name}={value:g}: must be > 0, from {LIGHTEST:g} to {HEAVIEST:g}")
        weights[name] = value
    return tuple(weights.get(name, 1.0) for name in states)


def write_text(path: Path | str, text: str) -> Path:
    """Writes a file. Raises UsageError where it cannot be written."""
    path = Path(path)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _of_function(
    step: Callable[..., Any],
    dt: float,
    param: Mapping[str, float],
    states: Sequence[str],
    inputs: Sequence[str],
    angles: Sequence[str],
    rates: Mapping[str, str],
    units: Mapping[str, str],
) -> Model:
    name = FUNCTION + getattr(step, "__name__", type(step).__name__)
    listed = {"STATES": states, "INPUTS": inputs, "ANGLES": angles}
    if text := [what for what, names in listed.items() if isinstance(names, str)]:
        raise UsageError(f"model: {text[0].lower()} is {listed[text[0]]!r}, must be a tuple of names")
    parts = {**{what: tuple(names) for what, names in listed.items()}, "PARAMS": dict(param), "RATES": dict(rates), "UNITS": dict(units)}
    try:
        nominal = model_of(name, SimpleNamespace(**parts, step=step))
    except ConfigError as error:
        message = str(error)
        for what in (*parts, "PARAMS"):
            message = message.replace(what, "param" if what == "PARAMS" else what.lower())
        raise ConfigError(message) from None
    spec = ModelSpec(name, dt, source_digest=_source_digest(step))
    return Model(compose(spec, "model", nominal), function=nominal)


def _source_digest(function: Callable[..., Any]) -> str:
    """Digest of the function's source, or of its code where the source is not known."""
    try:
        return digest(inspect.getsource(function).encode())
    except (OSError, TypeError):
        code = getattr(function, "__code__", None)
        return digest(b"" if code is None else code.co_code + repr(code.co_consts).encode())


def _needed_dt(dt: float | None) -> float:
    if dt is None or not 0.0 < dt < float("inf"):
        raise UsageError("model: a function needs its step: --dt DT (s), > 0")
    return float(dt)


def _named(name: str, dt: float) -> ModelSpec:
    try:
        return ModelSpec(name, dt)
    except ValueError as error:
        raise UsageError(f"--dt: {error}") from None


def _with_dt(spec: ModelSpec, dt: float) -> ModelSpec:
    if spec.fitted_on and dt != spec.dt:
        raise ConfigError(f"--dt {dt}: the model was fitted at a step of {spec.dt} s; its effects hold for that step")
    try:
        return msgspec.structs.replace(spec, dt=dt)
    except ValueError as error:
        raise UsageError(f"--dt: {error}") from None
