"""Parameters of a controller as something to be searched: the box that its file declares, what was tried, and a file with other values.

BOUNDS = {"speed": [0.05, 0.2]}        in the controller's file: a literal; parameters that have none stay as they are
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.controllers.policy import is_policy
from s2r_runtime.errors import ConfigError

Bounds = dict[str, tuple[float, float]]


class Candidate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters that were tried. cost: J; failures: share of rollouts below the threshold by law; trouble: what the controller raised."""

    parameters: dict[str, float]
    cost: float
    failures: dict[str, float] = {}
    progress: float = 0.0
    trouble: str = ""


class Synthesis(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was tried, in order, and the best of it. n: scenarios for each law that each was tried in; seed: theirs."""

    best: Candidate
    tried: tuple[Candidate, ...]
    n: int
    seed: int


def declared_bounds(file: ControllerFile, given: Mapping[str, tuple[float, float]]) -> Bounds:
    """The box: BOUNDS of the file, and in their place those given. Raises ConfigError for what is no box, or is of no parameter."""
    if is_policy(file.entry):
        raise ConfigError(f"{file.path}: a learned policy has no parameters to search")
    bounds = {**_literal(file), **given}
    if not bounds:
        raise ConfigError(
            f'{file.path}: declares no bounds to search within; must have BOUNDS = {{"name": [low, high]}} for its PARAMETERS'
        )
    for name, (low, high) in bounds.items():
        value = file.parameters.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{file.path}: BOUNDS of {name!r}, which is no number among its PARAMETERS: {', '.join(file.parameters)}")
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ConfigError(f"{file.path}: BOUNDS of {name!r} are [{low}, {high}], must be [low, high] with low < high, finite")
    return bounds


def _literal(file: ControllerFile) -> Bounds:
    for node in ast.parse(file.source).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        if any(isinstance(target, ast.Name) and target.id == "BOUNDS" for target in targets):
            try:
                found = ast.literal_eval(node.value)  # type: ignore[attr-defined] # both kinds of assignment have one
                return {str(name): (float(low), float(high)) for name, (low, high) in dict(found).items()}
            except (ValueError, TypeError, SyntaxError):
                raise ConfigError(f'{file.path}: line {node.lineno}: BOUNDS must be a literal: {{"name": [low, high]}}') from None
    return {}


def with_parameters(file: ControllerFile, parameters: Mapping[str, Any]) -> bytes:
    """The file's source with these values in PARAMETERS, and nothing else changed but the layout of that dict."""
    tree = ast.parse(file.source)
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        if any(isinstance(target, ast.Name) and target.id == "PARAMETERS" for target in targets):
            value = node.value  # type: ignore[attr-defined] # both kinds of assignment have one
            lines = file.source.decode("utf-8").splitlines(keepends=True)
            before = "".join(lines[: value.lineno - 1]) + lines[value.lineno - 1].encode()[: value.col_offset].decode()
            after = lines[value.end_lineno - 1].encode()[value.end_col_offset :].decode() + "".join(lines[value.end_lineno :])
            body = "".join(f"    {name!r}: {item!r},\n" for name, item in {**file.parameters, **parameters}.items())
            return f"{before}{{\n{body}}}{after}".encode()
    raise ConfigError(f"{Path(file.path).name}: has no PARAMETERS")
