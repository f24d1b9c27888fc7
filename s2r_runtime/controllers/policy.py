"""A learned policy as a controller: an ONNX file, and the TOML file of the same name (docs/learned-policies.md).

    history = 1                                              observations in a row, the newest last
    [[observations]]  name, offset, scale, clip              z = (o - offset) / scale, then limited to +-clip; in the network's order
    [[outputs]]       name, offset, scale, lower, upper      u = offset + scale * y, then limited; in the order of the robot's inputs

It is a `ControllerFile` like any other: `source` holds the ONNX bytes, `parameters` the settings, `entry` the version of what is
done with both. So one digest covers the network, its settings, the version of onnxruntime, and the meaning of the settings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.controllers.onnx_file import check_onnx
from s2r_runtime.errors import ConfigError, one_line
from s2r_runtime.files.bounded_file import MB, read_bounded
from s2r_runtime.files.toml_text import load_toml

SUFFIX = ".onnx"
ENTRY = "onnx 1"
"""Version of the settings' meaning. It is part of the digest: whoever changes the meaning counts up."""
ONNX_BYTES = 16 * MB
"""Four million weights. The file is attached to every log in which it drives."""
HISTORY_MAX = 32
"""Observations in a row: a second at the robots' periods."""
LIBRARIES = ("numpy", "onnxruntime")


class Observed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A state of the robot, or a value of the scenario. offset, scale: one number, or one for each element."""

    name: str
    offset: float | tuple[float, ...] = 0.0
    scale: float | tuple[float, ...] = 1.0
    clip: float | None = None


class Output(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An input of the robot, with its limits in the input's unit."""

    name: str
    lower: float
    upper: float
    offset: float = 0.0
    scale: float = 1.0


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The TOML file."""

    observations: tuple[Observed, ...]
    outputs: tuple[Output, ...]
    history: int = 1


def is_policy(entry: str) -> bool:
    """Whether a controller file's entry is that of a learned policy."""
    return entry.startswith("onnx ")


def settings_of(entry: str, parameters: Mapping[str, Any]) -> Settings:
    """The settings that a controller file holds. Raises ConfigError if they are of another version of this runtime."""
    if entry != ENTRY:
        raise ConfigError(f"the learned policy's settings are of version {entry!r}, this runtime reads {ENTRY!r}; load the file again")
    return msgspec.convert(parameters, Settings)


def read_policy(path: Path) -> tuple[bytes, dict[str, Any]]:
    """The bytes of the ONNX file, and its settings as plain data. Raises ConfigError, one line, naming the file that is wrong."""
    source = read_bounded(path, ONNX_BYTES)
    check_onnx(source, path)
    return source, msgspec.to_builtins(_read_settings(path.with_suffix(".toml"), path.name))


def _read_settings(path: Path, of: str) -> Settings:
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; {of} needs its observations, outputs and limits there")
    try:
        settings = msgspec.convert(load_toml(path), Settings)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {one_line(str(error))}") from None
    _check(settings, str(path))
    return settings


def _check(settings: Settings, where: str) -> None:
    """Raises ConfigError for settings that have the right form and make no sense."""
    if not 1 <= settings.history <= HISTORY_MAX:
        raise ConfigError(f"{where}: history is {settings.history}, must be from 1 to {HISTORY_MAX}")
    for kind, items in (("observations", settings.observations), ("outputs", settings.outputs)):
        names = [item.name for item in items]
        if not names:
            raise ConfigError(f"{where}: has no {kind}, must have at least one [[{kind}]]")
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"{where}: {kind} name {repeated[0]!r} twice; each once")
    for one in settings.observations:
        at = f"{where}: observation {one.name!r}"
        _finite(one.offset, f"{at}: offset")
        _finite(one.scale, f"{at}: scale", nonzero=True)
        if one.clip is not None and not 0.0 < one.clip < math.inf:
            raise ConfigError(f"{at}: clip is {one.clip:g}, must be finite and above 0")
    for output in settings.outputs:
        at = f"{where}: output {output.name!r}"
        _finite((output.lower, output.upper, output.offset), f"{at}: lower, upper or offset")
        _finite(output.scale, f"{at}: scale", nonzero=True)
        if output.lower >= output.upper:
            raise ConfigError(f"{at}: lower is {output.lower:g}, must be below upper, which is {output.upper:g}")


def _finite(value: float | Sequence[float], what: str, *, nonzero: bool = False) -> None:
    values = (value,) if isinstance(value, float | int) else value
    if not all(math.isfinite(v) and (v != 0.0 or not nonzero) for v in values) or not values:
        raise ConfigError(f"{what} is {value}, must be finite{' and not 0' if nonzero else ''}")
