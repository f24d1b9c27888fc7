"""A controller as data: the bytes that will run and all that decides what they do, with one digest of it (docs/gate.md).

    PARAMETERS = {"gain": 1.5}                 optional; a literal, because it is read without running anything
    def control(x, theta, parameters):         x (n, nx), theta: dict of arrays (n, ...), -> u (n, nu)
        ...

The digest covers the source, every module beside it that it imports (and that those import), the versions of the installed
distributions they import, the version of Python, the parameter values and the entry's name. The file is read once: what was
digested is what runs, whatever happens to the file afterwards. `control` must be a function of its arguments. What it
gets by other means than an import statement (`importlib`, the clock; data files where its process can open any) is not in the digest.

A learned policy (`.onnx`) is a controller without Python: its source is the network, its parameters are its settings (`policy`).
"""

from __future__ import annotations

import ast
import math
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.controllers import policy
from s2r_runtime.controllers.imports import Imports, installed, parse, read_source, version
from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest, digest_of

ENTRY = "control"
ARGUMENTS = ("x", "theta", "parameters")


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a controller's digest is taken of. `absent`: modules it would import if they were installed."""

    entry: str
    parameters: dict[str, Any]
    source: str
    modules: dict[str, str]
    packages: tuple[str, ...]
    libraries: dict[str, str]
    absent: tuple[str, ...]
    python: str

    def digest(self) -> str:
        """The controller digest that certificates carry."""
        return digest_of(self)


class ControllerFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A controller as it was read. modules: dotted name -> source of the local modules; `path` is for messages only."""

    path: str
    source: bytes
    parameters: dict[str, Any]
    modules: dict[str, bytes] = {}
    packages: tuple[str, ...] = ()
    libraries: dict[str, str] = {}
    absent: tuple[str, ...] = ()
    python: str = ""
    entry: str = ENTRY

    @property
    def identity(self) -> Identity:
        """What it is, with digests instead of sources."""
        modules = {name: digest(source) for name, source in self.modules.items()}
        source = digest(self.source)
        return Identity(self.entry, self.parameters, source, modules, self.packages, self.libraries, self.absent, self.python)

    @property
    def digest(self) -> str:
        """`sha256:...` over everything but the path."""
        return self.identity.digest()

    def as_found_here(self) -> ControllerFile:
        """The same bytes with the versions that this process would run them on. Equal digests: nothing has changed since `load`."""
        return msgspec.structs.replace(
            self,
            libraries={name: found for name in self.libraries if (found := version(name)) is not None},
            absent=tuple(name for name in self.absent if installed(name) is None),
            python=python_version(),
        )


def load(path: Path, parameters: Mapping[str, Any] | None = None) -> ControllerFile:
    """Reads a controller without running it. parameters: values in place of those in the file, for names that it has.

    Raises ConfigError: a file that is missing or doesn't parse (with the line), no `control(x, theta, parameters)`, PARAMETERS
    that are no literal, an import that is neither beside the file nor installed, or that means two things. For a learned policy: as
    `policy.read_policy`.
    """
    if path.suffix == policy.SUFFIX:
        return _load_policy(path, dict(parameters or {}))
    source = read_source(path)
    tree = parse(source, path)
    _check_entry(tree, path)
    values = _parameters(tree, path, dict(parameters or {}))
    imports = Imports(path.resolve().parent)
    try:
        imports.follow(tree, path, package="")
    except OSError as error:  # a name that no file can have
        raise ConfigError(f"{path}: what it imports cannot be looked for: {error.strerror}") from None
    return ControllerFile(
        path=str(path),
        source=source,
        parameters=values,
        modules=dict(sorted(imports.modules.items())),
        packages=tuple(sorted(imports.packages)),
        libraries=dict(sorted(imports.libraries.items())),
        absent=tuple(sorted(imports.absent)),
        python=python_version(),
    )


def _load_policy(path: Path, given: dict[str, Any]) -> ControllerFile:
    source, settings = policy.read_policy(path)
    if given:
        raise ConfigError(
            f"{path}: has no parameter {next(iter(given))!r}: a learned policy has none; change {path.with_suffix('.toml').name}"
        )
    libraries = {name: found for name in policy.LIBRARIES if (found := version(name)) is not None}
    if missing := [name for name in policy.LIBRARIES if name not in libraries]:
        raise ConfigError(f"{path}: needs {missing[0]}: pip install 's2r-runtime[onnx]'")
    return ControllerFile(
        path=str(path), source=source, parameters=settings, libraries=libraries, python=python_version(), entry=policy.ENTRY
    )


def python_version() -> str:
    """Implementation and version, as in `CPython 3.11.7`."""
    return f"{platform.python_implementation()} {platform.python_version()}"


# ---------------------------------------------------------------- the file itself


def _check_entry(tree: ast.Module, path: Path) -> None:
    wanted = f"def {ENTRY}({', '.join(ARGUMENTS)})"
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == ENTRY]
    if not found:
        names = [n.name for n in tree.body if isinstance(n, ast.FunctionDef)]
        raise ConfigError(f"{path}: has no function {ENTRY}; must have {wanted}" + (f"; it has: {', '.join(names)}" if names else ""))
    if len(found) > 1:
        raise ConfigError(f"{path}: line {found[1].lineno}: a second {ENTRY}; there must be one")
    a = found[0].args
    positional = len(a.posonlyargs) + len(a.args)
    takes_three = positional - len(a.defaults) <= len(ARGUMENTS) and (positional >= len(ARGUMENTS) or a.vararg is not None)
    if not takes_three or any(default is None for default in a.kw_defaults):
        raise ConfigError(f"{path}: line {found[0].lineno}: {ENTRY} must take three arguments: {wanted}")


def _parameters(tree: ast.Module, path: Path, given: dict[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    assigned = [(node, value) for node, value in _assignments(tree.body) if value is not None]
    if len(assigned) > 1:
        raise ConfigError(f"{path}: line {assigned[1][0].lineno}: PARAMETERS is set a second time; there must be one literal")
    for node, value in assigned:
        try:
            values = ast.literal_eval(value)
            ok = isinstance(values, dict) and all(isinstance(name, str) for name in values)
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            ok = False
        if not ok:
            raise ConfigError(f"{path}: line {node.lineno}: PARAMETERS must be a literal dict with text keys, it is read without running")
    for name, value in given.items():
        if name not in values:
            raise ConfigError(f"{path}: has no parameter {name!r}; it has: {', '.join(values) or 'none'}")
        values[name] = _like(values[name], value, f"{path}: parameter {name}")
    return {_utf8(name, str(path)): _plain(value, f"{path}: parameter {name}") for name, value in values.items()}


def _assignments(body: list[ast.stmt]) -> Iterator[tuple[ast.stmt, ast.expr | None]]:
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        if any(isinstance(target, ast.Name) and target.id == "PARAMETERS" for target in targets):
            yield node, node.value  # type: ignore[attr-defined] # both kinds of assignment have one


def _like(known: Any, value: Any, where: str) -> Any:
    """A value of the kind that the file has. A whole number stays one: it may count something."""
    if _kind(value) != _kind(known):
        raise ConfigError(f"{where} is {value!r}, must be {_kind(known)} as in the file ({known!r})")
    if isinstance(value, float) and type(known) is int and value.is_integer():
        return int(value)
    return float(value) if type(value) is int and isinstance(known, float) else value


def _kind(value: Any) -> str:
    for kinds, name in ((bool, "true or false"), ((int, float), "a number"), (str, "text"), ((list, tuple), "a list"), (dict, "a table")):
        if isinstance(value, kinds):
            return name
    return "nothing"


def _utf8(text: str, where: str) -> str:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{where}: holds a text that is not UTF-8 (a lone surrogate): {text!a}") from None
    return text


def _plain(value: Any, where: str) -> Any:
    """Plain JSON data, so that the digest and every process see the same. Tuples become lists."""
    if isinstance(value, str):
        return _utf8(value, where)
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int):
        if abs(value) >= 2**63:
            raise ConfigError(f"{where} is {value}, must be a 64-bit number")
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ConfigError(f"{where} is {value}, must be finite")
        return value
    if isinstance(value, list | tuple):
        return [_plain(item, where) for item in value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {_utf8(key, where): _plain(item, where) for key, item in value.items()}
    raise ConfigError(f"{where} is {value!r}, must be numbers, text, true or false, or lists and tables of them")
