"""What a controller imports: the modules beside it with their bytes, the installed distributions with their versions.

Import statements are followed through the syntax tree, in every module beside the file, without running anything. A name that means
two things (a file beside the controller and an installed module, or a module of Python) is refused: which of them ran would depend on
the process.

A distribution that is installed where it is developed ("editable") changes without a new version, so its version here has the digest of its
code behind it: `0.3.1 sha256:...`.
"""

from __future__ import annotations

import ast
import importlib.machinery
import json
import os
import site
import stat
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest, digest_of

SOURCE_MAX = 4 << 20
"""Bytes of source in all. They are attached to every log and handed to every process that runs them."""
CODE = {".py", ".so", ".pyd"}
FILES_MAX = 5000
"""Files of an editable distribution that are looked at, at every start of a controller."""


class Imports:
    """Everything reached from the files that were `follow`ed. modules: dotted name -> source; libraries: distribution -> version.

    packages: those of `modules` that are packages. absent: names imported inside a `try` that are not installed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.modules: dict[str, bytes] = {}
        self.packages: set[str] = set()
        self.libraries: dict[str, str] = {}
        self.absent: set[str] = set()

    def follow(self, tree: ast.Module, path: Path, package: str) -> None:
        """Takes note of what a file imports. package: the local package it is in, or empty. Raises ConfigError as `load`."""
        optional = _optional(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    self._take(alias.name, f"{path}: line {node.lineno}", optional=node in optional)
            elif isinstance(node, ast.ImportFrom):
                where = f"{path}: line {node.lineno}"
                base = _absolute(node, package, where)
                self._take(base, where, optional=node in optional)
                for alias in node.names:  # `from package import module`
                    if base in self.packages and self._local(f"{base}.{alias.name}") is not None:
                        self._take_local(f"{base}.{alias.name}", where)

    def _take(self, name: str, where: str, *, optional: bool) -> None:
        top = name.partition(".")[0]
        builtin = top in sys.stdlib_module_names or top == "__main__"
        local, origin = self._local(top), None if builtin else installed(top, self.folder)
        if local is not None and local.is_dir() and (builtin or origin is not None):
            local = None  # a folder without __init__.py is a module only where nothing else is: that is Python's rule, too
        if local is not None and (builtin or (origin is not None and not _same(origin, local))):
            raise ConfigError(f"{where}: imports {top}, which is {local} and also {origin or 'a module of Python'}; rename the file")
        if builtin:
            return
        if origin is not None:
            self._take_installed(top, origin, where)
        elif local is not None:
            self._take_local(name, where)
        elif optional:
            self.absent.add(top)
        else:
            raise ConfigError(f"{where}: imports {name}, which is neither beside the controller nor installed")

    def _take_installed(self, top: str, origin: str, where: str) -> None:
        name = _distribution(top, origin)
        if name is None:
            raise ConfigError(f"{where}: imports {top} from {origin}, of no installed package, so its version is unknown; put it beside")
        self.libraries[name] = version(name) or ""

    def _take_local(self, name: str, where: str) -> None:
        parts = name.split(".")
        for depth in range(1, len(parts) + 1):
            module = ".".join(parts[:depth])
            if module in self.modules:
                continue
            path = self._local(module)
            if path is None:
                raise ConfigError(f"{where}: imports {name}, but {self.folder.joinpath(*parts[:depth])}.py is not there")
            is_package = path.is_dir() or path.name == "__init__.py"
            source = b"" if path.is_dir() else read_source(path)
            self.modules[module] = source
            if is_package:
                self.packages.add(module)
            if sum(map(len, self.modules.values())) > SOURCE_MAX:
                raise ConfigError(f"{where}: the modules beside the controller have more than {SOURCE_MAX} bytes")
            self.follow(parse(source, path), path, module if is_package else module.rpartition(".")[0])

    def _local(self, module: str) -> Path | None:
        """The file of a local module, the folder of a local package without `__init__.py`, or None."""
        base = self.folder.joinpath(*module.split("."))
        for path in (base / "__init__.py", base.with_name(base.name + ".py")):
            if path.is_file():
                return path
        return base if base.is_dir() and next(base.glob("*.py"), None) is not None else None


def read_source(path: Path) -> bytes:
    """A source file's bytes. Raises ConfigError if it can't be read or is too big."""
    try:
        # not blocking: a pipe that nobody writes to has no end either
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{path}: is no file")
            source = file.read(SOURCE_MAX + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if len(source) > SOURCE_MAX:
        raise ConfigError(f"{path}: has more than {SOURCE_MAX} bytes, all that a controller with its modules may have")
    return source


def parse(source: bytes, path: Path) -> ast.Module:
    """The syntax tree. Raises ConfigError with the line if it is no Python."""
    try:
        return ast.parse(source, str(path))
    except SyntaxError as error:
        raise ConfigError(f"{path}: line {error.lineno}: {error.msg}") from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(f"{path}: is no Python source: {error}") from None


def installed(top: str, folder: Path | None = None) -> str | None:
    """Where an installed top-level module is; None if there is none. What is found only because it lies in `folder` is not installed."""
    places = [entry for entry in sys.path if entry and (folder is None or Path(entry).resolve() != folder)]
    spec = importlib.machinery.PathFinder.find_spec(top, places)
    if spec is None:  # editable installations have finders of their own
        finders = (f for f in sys.meta_path if getattr(f, "__module__", "").startswith("__editable__"))
        spec = next((found for f in finders if (found := f.find_spec(top, None, None)) is not None), None)
    if spec is None:
        return None
    return spec.origin or next(iter(spec.submodule_search_locations or ()), top)


def version(distribution: str) -> str | None:
    """The installed version, with the digest of its code if it is installed where it is developed; or None. Raises ConfigError if that code
    can't be read.
    """
    try:
        found = metadata.distribution(distribution)
    except metadata.PackageNotFoundError:
        return None
    return f"{found.version} {_code_digest(found)}" if _editable(found) else found.version


def _editable(found: metadata.Distribution) -> bool:
    """By PEP 610, or because it lies outside of where packages are installed; a record that can't be understood counts as one."""
    about = found.read_text("direct_url.json")
    if about is None:
        place = Path(str(found.locate_file(""))).resolve()
        return not any(place.is_relative_to(Path(prefix).resolve()) for prefix in (sys.prefix, sys.base_prefix, site.getusersitepackages()))
    try:
        return bool(json.loads(about).get("dir_info", {}).get("editable", False))
    except (ValueError, AttributeError):
        return True


def _code_digest(found: metadata.Distribution) -> str:
    """Digest of the names and bytes of all code in the distribution's packages."""
    tops = (found.read_text("top_level.txt") or "").split()
    tops = tops or [top for top, names in metadata.packages_distributions().items() if found.name in names]
    code: dict[str, str] = {}
    for top in tops:
        if (origin := installed(top)) is None:
            continue
        base = Path(origin)
        folder = base.parent if base.name == "__init__.py" else base
        try:
            files, again = ([base], {}) if folder.is_file() else _code_files(folder)
            if len(files) > FILES_MAX:
                raise ConfigError(f"{folder}: has more than {FILES_MAX} files of code; install {found.name} as a wheel, not editable")
            code.update({f"{top}/{path.relative_to(base.parent)}": digest(path.read_bytes()) for path in files})
            code.update({f"{top}/{path.relative_to(base.parent)}": f"as {first.relative_to(base.parent)}" for path, first in again.items()})
        except OSError as error:
            raise ConfigError(f"{error.filename or folder}: cannot be read: {error.strerror}") from None
    return digest_of(code)


def _code_files(folder: Path) -> tuple[list[Path], dict[Path, Path]]:
    """All code in a folder and in those that links in it lead to; and the links that lead where another way led before (a ring, too), with
    that way. Raises OSError for a folder that can't be listed: it may hold code all the same.
    """
    files: list[Path] = []
    first: dict[str, Path] = {}
    again: dict[Path, Path] = {}

    def unreadable(error: OSError) -> None:
        raise error

    for where, folders, names in os.walk(folder, followlinks=True, onerror=unreadable):
        here, real = Path(where), os.path.realpath(where)
        if real in first:
            again[here] = first[real]
            folders.clear()
            continue
        first[real] = here
        folders.sort()
        files += [path for name in sorted(names) if (path := here / name).suffix in CODE and path.is_file()]
        if len(files) > FILES_MAX:
            break
    return files, again


def _distribution(top: str, origin: str) -> str | None:
    """The distribution that a module comes from. Most bear its name; asking all of them takes 0.1 s."""
    try:
        found = metadata.distribution(top)
    except metadata.PackageNotFoundError:
        found = None
    if found is not None and Path(origin).resolve().is_relative_to(Path(str(found.locate_file(top))).resolve()):
        return found.name
    return next(iter(metadata.packages_distributions().get(top, ())), None)


def _optional(tree: ast.Module) -> set[ast.AST]:
    """The nodes inside a `try`, or under `if TYPE_CHECKING`: imports there may fail, or never run."""
    return {inner for node in ast.walk(tree) for item in _guarded(node) for inner in ast.walk(item)}


def _guarded(node: ast.AST) -> Iterator[ast.stmt]:
    if isinstance(node, ast.Try) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
        yield from node.body


def _absolute(node: ast.ImportFrom, package: str, where: str) -> str:
    """The absolute name of the module in `from ... import`. Raises ConfigError for one outside the controller's folder."""
    if not node.level:
        return node.module or ""
    parts = package.split(".") if package else []
    if node.level > len(parts):
        text = "." * node.level + (node.module or "")
        raise ConfigError(f"{where}: 'from {text} import ...' leaves the controller's folder; import what is beside it by its name")
    return ".".join([*parts[: len(parts) - node.level + 1], *([node.module] if node.module else [])])


def _same(origin: str, local: Path) -> bool:
    """An editable installation of the very folder: it is installed."""
    return Path(origin).resolve() == local.resolve()
