"""A model as data: a name, a step, parameter values and the effects that were added. What a profile's `[model]` table and a
repaired model's TOML hold, and what a model digest is taken of.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest_of
from s2r_runtime.files.toml_text import load_toml, parse_toml

TIME, SEGMENT = "t", "segment"
"""Columns of a table that no state and no input may be named like: the stamps, and the number of the run."""
PREFIX = "rows:"
"""A sketch of rows stands among `ModelSpec.fitted_on` with this before it: 40 bits a hash, as earlier versions wrote it (`seen_rows`)."""
COMPACT = "rows2:"
"""The same, as it is written now."""


class EffectSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One effect that the model has."""

    name: str
    """One of those on the page of effects, or a plug-in's."""
    channel: str = "*"
    """The input or state that it acts on; `*`: all alike."""
    parameters: dict[str, float | str | list[list[float]]] = {}
    """In SI units."""

    def __post_init__(self) -> None:
        _check_finite(self.parameters, f"{self.name}.")


class ModelSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The simple model, and what is known to be added to it."""

    name: str
    """A model that is built in or comes from a plug-in, or the path of a Python file."""
    dt: float
    """s; its step."""
    parameters: dict[str, float] = {}
    """Of the model, in SI units, by name."""
    effects: tuple[EffectSpec, ...] = ()
    """`[[model.effects]]`, in order: what the data sheet says, and what tracing found."""
    fitted_on: tuple[str, ...] = ()
    """Digests of the recordings that effects were fitted on, and sketches of their rows; a gap is refused on those (guarantee G6).
    Tracing writes it."""
    source_digest: str = ""
    """Of the Python file; filled when it is loaded."""

    def __post_init__(self) -> None:
        if not 0.0 < self.dt < float("inf"):
            raise ValueError(f"dt is {self.dt} s, must be > 0")
        _check_finite(self.parameters, "parameters.")

    def digest(self) -> str:
        """Digest of what the model computes: two specs with the same digest step alike. `fitted_on` is no part of it."""
        name = "file" if self.source_digest else self.name
        return digest_of(msgspec.structs.replace(self, name=name, fitted_on=()))


def is_sketch(text: str) -> bool:
    """Whether this one of `ModelSpec.fitted_on` is a sketch of rows; else it is a digest."""
    return text.startswith((PREFIX, COMPACT))


def form_of(fitted_on: Sequence[str]) -> str:
    """The newest form of the sketches that a model has: COMPACT or PREFIX; empty without any."""
    return next((form for form in (COMPACT, PREFIX) if any(text.startswith(form) for text in fitted_on)), "")


def load_model(path: Path) -> ModelSpec:
    """Reads a model TOML (table `[model]`). Raises ConfigError naming file and field."""
    table = load_toml(path)
    if "model" not in table:
        raise ConfigError(f"{path}: has no [model] table")
    for name in ModelSpec.__struct_fields__:
        if name in table:
            raise ConfigError(f"{path}: has {name} beside [model], where nothing reads it; it must be in that table")
    try:
        return msgspec.convert(table["model"], ModelSpec)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: model: {error}") from None


def dump_model(spec: ModelSpec, comments: tuple[str, ...] = ()) -> str:
    """The TOML text of a model; `load_model` of it gives an equal spec. comments: lines for the reader."""
    lines = [f"# {line}" for line in comments]
    lines += ["[model]", f"name = {_toml(spec.name)}", f"dt = {spec.dt!r}"]
    if spec.fitted_on:
        lines.append(f"fitted_on = {_toml(list(spec.fitted_on))}")
    if spec.source_digest:
        lines.append(f"source_digest = {_toml(spec.source_digest)}")
    if spec.parameters:
        lines += ["", "[model.parameters]", *(f"{_toml(k)} = {_toml(v)}" for k, v in spec.parameters.items())]
    for effect in spec.effects:
        lines += ["", "[[model.effects]]", f"name = {_toml(effect.name)}", f"channel = {_toml(effect.channel)}"]
        if effect.parameters:
            lines += ["[model.effects.parameters]", *(f"{_toml(k)} = {_toml(v)}" for k, v in effect.parameters.items())]
    return "\n".join(lines) + "\n"


def _check_finite(parameters: Mapping[str, object], where: str) -> None:
    """Raises ValueError: JSON, in which models go to other processes and into digests, has no NaN and no infinity."""
    for name, value in parameters.items():
        rows = value if isinstance(value, list) else [[value]]
        if any(isinstance(item, float) and not math.isfinite(item) for row in rows for item in row):
            raise ValueError(f"{where}{name} must be finite")


def _toml(value: object) -> str:
    """A TOML literal. JSON's strings are TOML basic strings; keys are written quoted."""
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return msgspec.json.encode(value).decode()


def parse_model(text: str, base: str, where: str) -> ModelSpec:
    """A model from the text of a TOML; a Python file in it is looked up from `base`. Raises ConfigError."""
    table = parse_toml(text, where)
    if "model" not in table:
        raise ConfigError(f"{where}: has no [model] table")
    try:
        spec = msgspec.convert(table["model"], ModelSpec)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: model: {error}") from None
    if spec.name.endswith(".py"):
        path = Path(base) / spec.name
        spec = msgspec.structs.replace(spec, name=str(path.resolve()))
    return spec
