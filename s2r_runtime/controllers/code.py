"""Executes exactly the bytes that a controller's digest was taken of, in this process. For child and worker processes.

Modules beside the controller come from memory, by an importer that stands before all others; the file system is not asked again.
What `control` gets it can only read, and what it returns is checked: u (n, nu), finite.
"""

from __future__ import annotations

import importlib.abc
import importlib.util
import sys
import types
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.controllers.policy import is_policy
from s2r_runtime.errors import ConfigError, ControllerError, one_line
from s2r_runtime.hookspecs import Scenario

Array = NDArray[np.float64]
Control = Callable[[Array, Scenario], Array]

DETAIL_MAX = 300
"""Characters of a controller's error that are passed on."""


class Raised(ControllerError):
    """The controller raised, or asked to exit."""


class Malformed(ControllerError):
    """The controller returned something that is not a finite input of the right shape."""


def batch_control(file: ControllerFile, nu: int | None = None) -> Control:
    """`control(x, theta) -> u`: x (n, nx), theta arrays (n, ...), u (n, nu) float64 of the caller's own.

    nu: the model's number of inputs; None: any. For a learned policy theta has its observations (`observing`).
    Raises ControllerError if libraries have changed since `load`, if the
    file raises when it is executed, and, when called, Raised or Malformed.
    """
    if (here := file.as_found_here()).digest != file.digest:
        raise ControllerError(f"{file.path}: {_difference(file, here)}; verify it again as it is now")
    entry = _execute(file, nu)
    if (here := file.as_found_here()).digest != file.digest:  # what is not in memory was read from the disk in between
        raise ControllerError(f"{file.path}: while it was started, {_difference(file, here)}; verify it again as it is now")

    reasons = (ConfigError, Raised, Malformed) if is_policy(file.entry) else ()  # whose text has the file's name already

    def control(x: Array, theta: Scenario) -> Array:
        try:
            result = entry(_readable(x), {name: _readable(value) for name, value in theta.items()}, dict(file.parameters))
        except reasons:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a controller may raise anything; that is its answer
            raise Raised(f"{Path(file.path).name}: {_describe(error)}") from None
        try:
            return _checked(result, len(x), nu)
        except ValueError as error:
            raise Malformed(f"{Path(file.path).name}: {one_line(str(error))}") from None

    return control


def _readable(value: Any) -> Any:
    """A view that cannot be written to: a controller that changes its scenario changes what it is verified on."""
    if not isinstance(value, np.ndarray):
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def _checked(result: Any, n: int, nu: int | None) -> Array:
    """u (n, nu), a copy. Raises ValueError saying what it is and what it must be."""
    wanted = f"must be an array of shape ({n}, {'nu' if nu is None else nu})"
    try:
        u = np.asarray(result)
    except Exception as error:  # noqa: BLE001 - ragged lists, objects with an `__array__` of their own
        raise ValueError(f"control returned {type(result).__name__} ({error}), {wanted}") from None
    if u.dtype.kind not in "fiu":
        raise ValueError(f"control returned {type(result).__name__} of {u.dtype}, {wanted}")
    if u.ndim != 2 or u.shape[0] != n or (nu is not None and u.shape[1] != nu):
        raise ValueError(f"control returned shape {u.shape}, {wanted}")
    u = u.astype(np.float64)
    finite = np.isfinite(u)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise ValueError(f"control returned {u[row, column]} (row {row}, input {column}), must be finite")
    return u


# ---------------------------------------------------------------- executing


class _Memory(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Finds and loads the modules of controllers, from memory."""

    def __init__(self) -> None:
        self.modules: dict[str, bytes] = {}
        self.packages: set[str] = set()

    def find_spec(self, fullname: str, path: Sequence[str] | None = None, target: types.ModuleType | None = None) -> ModuleSpec | None:
        if fullname not in self.modules:
            return None
        return importlib.util.spec_from_loader(fullname, self, is_package=fullname in self.packages)

    def is_package(self, fullname: str) -> bool:
        return fullname in self.packages

    def get_source(self, fullname: str) -> str:
        return importlib.util.decode_source(self.modules[fullname])

    def get_code(self, fullname: str) -> types.CodeType:
        return _compile(self.modules[fullname], fullname.replace(".", "/") + ".py")


_MEMORY = _Memory()


def _execute(file: ControllerFile, nu: int | None) -> Callable[..., Any]:
    """Runs the source as a module and returns its entry. Raises ControllerError if that fails, ConfigError for a bad network."""
    name = Path(file.path).name
    if is_policy(file.entry):
        from s2r_runtime.controllers.onnx_session import Policy

        return Policy(file, name, nu)
    for module, source in file.modules.items():
        if _MEMORY.modules.setdefault(module, source) != source:
            raise ControllerError(f"{name}: imports {module}, and another controller in this process has a different one of that name")
    _MEMORY.packages.update(file.packages)
    if _MEMORY not in sys.meta_path:
        sys.meta_path.insert(0, _MEMORY)
    module_name = f"controller_{file.digest[7:19]}"
    scope = types.ModuleType(module_name)
    sys.modules[module_name] = scope  # dataclasses look their module up
    try:
        exec(_compile(file.source, name), scope.__dict__)  # noqa: S102 - the bytes that were digested, and no others
    except (Exception, SystemExit) as error:  # noqa: BLE001 - as in `control`
        raise Raised(f"{name}: {_describe(error)}") from None
    if file.parameters:
        scope.__dict__["PARAMETERS"] = dict(file.parameters)  # the values in force, for code that reads the global
    entry = getattr(scope, file.entry, None)
    if not callable(entry):
        raise ControllerError(f"{name}: has no function {file.entry} once it has run")
    function: Callable[..., Any] = entry
    return function


def _compile(source: bytes, name: str) -> types.CodeType:
    # in angle brackets, so that nobody takes it for a file and reads lines of what is there now
    return compile(source, f"<{name}>", "exec", dont_inherit=True)


def _describe(error: BaseException) -> str:
    """`ValueError: text (grid.py line 7)`: the innermost line that is the controller's own."""
    where, step = "", error.__traceback__
    while step is not None:
        filename = step.tb_frame.f_code.co_filename
        if filename.startswith("<") and filename.endswith(".py>"):
            where = f" ({filename[1:-1]} line {step.tb_lineno})"
        step = step.tb_next
    if isinstance(error, SyntaxError):
        where = f" ({(error.filename or '').strip('<>')} line {error.lineno})"
    try:
        text = str(error.msg if isinstance(error, SyntaxError) else error)
        if isinstance(error, PermissionError):
            text += "; a controller opens no files: what it needs stands in its PARAMETERS, or in a module beside it"
    except Exception:  # noqa: BLE001 - an exception class of its own whose text raises
        text = "no text"
    return one_line(f"{type(error).__name__}: {text}", DETAIL_MAX - len(where)) + where


def _difference(file: ControllerFile, here: ControllerFile) -> str:
    if file.python != here.python:
        return f"was digested under {file.python}, this is {here.python}"
    for name, version in file.libraries.items():
        if here.libraries.get(name) != version:
            return f"was digested with {name} {version}, here is {here.libraries.get(name) or 'none'}"
    return "a library that was not installed when it was digested is installed now"
