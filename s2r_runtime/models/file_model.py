"""A user's Python file as a nominal model: whatever it does wrong is one line that names the file and the place in it.

What it prints goes to stderr, since stdout belongs to the results of the program that uses it.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import math
import sys
import traceback
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, one_line
from s2r_runtime.files.bounded_file import read_bounded
from s2r_runtime.files.canonical import digest
from s2r_runtime.hookspecs import Follows, NominalModel
from s2r_runtime.modelspec import SEGMENT, TIME, ModelSpec

Array = NDArray[np.float64]

KEPT, LARGE = 64, 30_000
"""Results that are kept, and the numbers in a state table from which on none is: a trace asks for the same rows again beside every force
that it tries, and somebody's own integration takes most of its time.
"""

SAMPLED = 64
"""Numbers of a table by which what is kept is looked up. They mostly differ where tables do, and to hash all of a table takes about as long
as to step it; whether all are the same is then asked of the one that is kept.
"""

PROBED, PROBED_S = 0.5, 0.01
"""States and inputs, and a step in s, with which a file's `step` is asked once or twice whether it takes a table. What it prints then
goes nowhere.
"""

EACH, FAR, EACH_S = 24, (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0), (1e-3, 10.0)
"""Rows near to PROBED, and as many of these sizes, by which a file's `step` is asked whether it takes a dt for each; and what these are
spread between, s.
"""

Asked = tuple[tuple[int, ...], bytes, bytes, bytes, tuple[tuple[str, float], ...]]


class NoNumbers(ConfigError):
    """A step gives none in some rows, (n,) of those that it was asked for: the others need not be asked one by one."""

    def __init__(self, message: str, rows: NDArray[np.bool_]) -> None:
        super().__init__(message)
        self.rows = rows


@dataclass
class FileModel:
    """The names in the file, and its `step`."""

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    parameters: dict[str, float]
    function: Callable[..., Any]
    follows: dict[str, Follows] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    _known: OrderedDict[Asked, tuple[Array, Array, Array, Array]] = field(
        default_factory=OrderedDict, init=False, repr=False, compare=False
    )

    @cached_property
    def uneven(self) -> bool:
        """Whether `step` also takes dt as (n,), one a row."""
        return self._column is not None

    @cached_property
    def _column(self) -> bool | None:
        """Whether the file's `step` takes dt of each row as a column, (n, 1); False: as (n,); None: neither. Most that are written for
        one dt take one of the two, by how they are written: it is asked, and counts if all rows are as they are alone, each with its own.
        """
        nx, nu = len(self.states), len(self.inputs)
        rng = np.random.default_rng(0)
        near = [rng.uniform(PROBED / 2.0, PROBED, (EACH, columns)) for columns in (nx, nu)]
        far = [rng.choice(FAR, (EACH, columns)) * rng.uniform(-1.0, 1.0, (EACH, columns)) for columns in (nx, nu)]
        x, u = (np.concatenate(tables) for tables in zip(near, far, strict=True))
        lasts = rng.permutation(np.geomspace(*EACH_S, len(x)))
        forms = [column for column in (False, True) if self._takes(near[0], near[1], lasts[:EACH, None] if column else lasts[:EACH])]
        if not forms:  # one that counts its own parts of a step takes long for many rows one by one
            return None
        there, alone = [], []
        for k in range(len(x)):  # not everywhere does it give numbers
            with contextlib.suppress(ConfigError), contextlib.redirect_stderr(io.StringIO()):  # where what it prints would go
                alone.append(self._called(x[k : k + 1], u[k : k + 1], float(lasts[k]), self.parameters))
                there.append(k)
        if len(there) <= nx + nu + 2:  # a table that is wrongly laid out, (n, n) or (nx, n), is not taken for one of states
            return None
        for column in forms:
            with contextlib.suppress(ConfigError), contextlib.redirect_stderr(io.StringIO()):
                together = self._called(x[there], u[there], lasts[there, None] if column else lasts[there], self.parameters)
                if np.allclose(together, np.concatenate(alone), rtol=1e-9, atol=1e-12):
                    return column
        return None

    def _takes(self, x: Array, u: Array, dt: Array) -> bool:
        """Whether `step` takes this dt, whatever it makes of it."""
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                self._called(x, u, dt, self.parameters)
        except ConfigError as error:
            return isinstance(error, NoNumbers)
        return True

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """Calls the file's `step`: x (n, nx), u (n, nu) -> (n, nx). dt: s; also (n,), where `uneven`.

        Raises ConfigError if it raises or exits, or if its result has the wrong shape, or is not finite where x and u are.
        """
        lasts = np.asarray(dt)
        if lasts.ndim:
            dt = lasts[:, None] if self._column else lasts
        if x.size > LARGE:
            return self._called(x, u, dt, parameters)
        asked = (x.shape, _sampled(x), _sampled(u), _sampled(lasts), tuple(parameters.items()))
        known = self._known.pop(asked, None)
        if known is None or not all(map(_same, known, (x, u, lasts))):
            known = x.copy(), u.copy(), lasts.copy(), self._called(x, u, dt, parameters)
        self._known[asked] = known
        while len(self._known) > KEPT:
            self._known.popitem(last=False)
        return known[3].copy()

    def _called(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        try:
            # a division by zero shows in the result, which is checked; a step in place may change what it is given
            with contextlib.redirect_stdout(sys.stderr), np.errstate(all="ignore"):
                given = np.asarray(self.function(x.copy(), u.copy(), dt.copy() if isinstance(dt, np.ndarray) else dt, dict(parameters)))
                result = np.array(given.real if np.iscomplexobj(given) else given, dtype=np.float64)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a user's file: whatever it raises is its report
            raise _failed(self.name, "step", error) from None
        if np.iscomplexobj(given):
            raise ConfigError(f"{self.name}: step returned complex numbers, must return real ones")
        if result.shape != x.shape:
            raise ConfigError(f"{self.name}: step returned shape {result.shape}, must be {x.shape}")
        if not np.isfinite(result).all():  # as it mostly is: asking which rows were given so takes as long as a simple step
            self._check_finite(x, u, result)
        return result

    def _check_finite(self, x: Array, u: Array, result: Array) -> None:
        given = np.isfinite(np.hstack([x, u])).all(axis=1, keepdims=True)
        wrong = np.argwhere(~np.isfinite(result) & given)
        if len(wrong):
            row, column = map(int, wrong[0])
            raise NoNumbers(
                f"{self.name}: step returned {result[row, column]} for state {self.states[column]!r} in row {row}"
                f" (x = {x[row].tolist()}, u = {u[row].tolist()}), must be finite",
                np.asarray((~np.isfinite(result) & given).any(axis=1)),
            )


def _sampled(table: Array) -> bytes:
    """Some of its numbers, from all of it."""
    numbers = table.reshape(-1)
    apart = max(1, len(numbers) // SAMPLED)
    while table.ndim > 1 and math.gcd(apart, table.shape[1]) > 1:  # else they would all be of a few columns
        apart -= 1
    return numbers[::apart].tobytes()


def _same(one: Array, other: Array) -> bool:
    """Whether two tables hold the same bytes: what has no number in a place is the same as what has none there, and -0 is not 0."""
    return one.shape == other.shape and np.array_equal(_bits(one), _bits(other))


def _bits(table: Array) -> NDArray[np.int64]:
    return np.ascontiguousarray(table, dtype=np.float64).view(np.int64)


def load_file_model(spec: ModelSpec, where: str) -> NominalModel:
    """The model in the file that `spec` names. Raises ConfigError saying what is wrong, and in which line."""
    path = Path(spec.name)
    try:
        source = read_bounded(path)
    except ConfigError as error:
        raise ConfigError(f"{where}.name: {error}") from None
    module = _run(path)
    if spec.source_digest and spec.source_digest != digest(source):
        raise ConfigError(f"{path}: has changed since the model was saved (digest {digest(source)}, saved {spec.source_digest})")
    return model_of(path, module)


def model_of(path: Path | str, module: ModuleType | SimpleNamespace) -> FileModel:
    """The model that a module's names make: STATES, INPUTS, PARAMS, step(x, u, dt, params), and maybe ANGLES, RATES, UNITS.

    path: how messages call it. Raises ConfigError saying what is wrong.
    """
    for name in ("STATES", "INPUTS", "PARAMS", "step"):
        if not hasattr(module, name):
            raise ConfigError(f"{path}: lacks {name}; a model file has STATES, INPUTS, PARAMS and step(x, u, dt, params)")
    if not callable(module.step):
        raise ConfigError(f"{path}: step is {module.step!r}, must be a function step(x, u, dt, params)")
    try:
        parameters = {str(k): float(v) for k, v in dict(module.PARAMS).items()}
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: PARAMS must be a dict of numbers: {error}") from None
    if wrong := [f"{name} = {value}" for name, value in parameters.items() if not math.isfinite(value)]:
        raise ConfigError(f"{path}: PARAMS has {wrong[0]}, must be finite numbers")
    states, inputs, angles = (_names(path, module, name) for name in ("STATES", "INPUTS", "ANGLES"))
    _check_columns(path, states, inputs)
    if unknown := [name for name in angles if name not in states]:
        raise ConfigError(f"{path}: ANGLES names {unknown[0]!r}, must name states: {', '.join(states)}")
    _check_batched(path, module.step, len(states), len(inputs), parameters)
    return FileModel(
        str(path), states, inputs, angles, parameters, module.step, _follows(path, module, states), _units(path, module, (*states, *inputs))
    )


def _run(path: Path) -> ModuleType:
    """The module that the file makes."""
    module_spec = importlib.util.spec_from_file_location(path.stem, path)
    if module_spec is None or module_spec.loader is None:
        raise ConfigError(f"{path}: is not a Python file")
    module = importlib.util.module_from_spec(module_spec)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            module_spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a user's file: whatever it raises is its report
        raise _failed(str(path), "loading it", error) from None
    return module


def _check_batched(path: Path | str, step: Callable[..., Any], nx: int, nu: int, parameters: dict[str, float]) -> None:
    """Raises ConfigError if `step` takes one state, and not a table of them: else that would show only after hours, row by row."""

    def taken(x: Array, u: Array) -> bool:
        try:
            with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
                return bool(np.shape(step(x, u, PROBED_S, dict(parameters))) == x.shape)
        except (Exception, SystemExit):  # noqa: BLE001 - it may want other values: what it raises is told where it is asked for some
            return False

    rows = nx + nu + 1  # one state at a time, taken for so many, makes no table of as many rows
    tables = np.full((rows, nx), PROBED), np.full((rows, nu), PROBED)
    if not taken(*tables) and taken(*(table[0] for table in tables)):
        raise ConfigError(
            f"{path}: step takes one state at a time, must take a table of them: x is (n, {nx}), u is (n, {nu}), the result (n, {nx}), "
            "so that column j of all rows is x[:, j]"
        )


def _names(path: Path | str, module: ModuleType | SimpleNamespace, name: str) -> tuple[str, ...]:
    given = getattr(module, name, ())
    if not isinstance(given, tuple | list) or not all(isinstance(one, str) for one in given):
        raise ConfigError(f"{path}: {name} is {given!r}, must be a tuple of names")
    return tuple(given)


def _check_columns(path: Path | str, states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Each state and each input is a column of its own in a recording, beside those of the time and the run."""
    for what, names in (("STATES", states), ("INPUTS", inputs)):
        if not names:
            raise ConfigError(f"{path}: {what} is empty, must name at least one")
    names = (*states, *inputs)
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path}: {twice[0]!r} stands {names.count(twice[0])} times in STATES and INPUTS, must stand there once")
    if taken := [name for name in names if name in (TIME, SEGMENT)]:
        raise ConfigError(f"{path}: {taken[0]!r} is no name for a state or an input: in recordings it is the column of the time or the run")


def _follows(path: Path | str, module: ModuleType | SimpleNamespace, states: tuple[str, ...]) -> dict[str, Follows]:
    """RATES = {"vx": "x"}: states that are rates of others, and so need not be measured."""
    given = getattr(module, "RATES", {})
    if not isinstance(given, dict) or not {*given, *given.values()} <= {*states} or {*given} & {*given.values()}:
        raise ConfigError(f"{path}: RATES is {given!r}, must be a dict of states and the states whose rates they are")
    return {name: Follows((of,), partial(_rate, of)) for name, of in given.items()}


def _units(path: Path | str, module: ModuleType | SimpleNamespace, columns: tuple[str, ...]) -> dict[str, str]:
    """UNITS = {"x": "m", "force": "N"}: SI units of states and inputs, as far as they are said."""
    given = getattr(module, "UNITS", {})
    if not isinstance(given, dict) or not all(isinstance(unit, str) and unit and unit.isprintable() for unit in given.values()):
        raise ConfigError(f"{path}: UNITS is {given!r}, must be a dict of states and inputs and their units as text")
    if unknown := [name for name in given if name not in columns]:
        raise ConfigError(f"{path}: UNITS names {unknown[0]!r}, must name states and inputs: {', '.join(columns)}")
    return dict(given)


def _rate(of: str, x: dict[str, Array], rates: dict[str, Array], parameters: dict[str, float]) -> Array:
    return rates[of]


def _failed(path: str, doing: str, error: BaseException) -> ConfigError:
    """What the file raised, and the last of its lines that took part."""
    line = error.lineno if isinstance(error, SyntaxError) and error.filename == path else None
    for frame in traceback.extract_tb(error.__traceback__):
        if frame.filename == path:
            line = frame.lineno
    what = "ended the program (SystemExit)" if isinstance(error, SystemExit) else f"raised {type(error).__name__}: {one_line(str(error))}"
    return ConfigError(f"{path}{'' if line is None else f', line {line}'}: {doing} {what}")
