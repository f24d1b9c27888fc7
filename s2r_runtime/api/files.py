"""Files that a verb writes: refused before the work where they cannot be written, or would replace what is read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.errors import UsageError

if TYPE_CHECKING:
    from s2r_runtime.modelspec import ModelSpec


def writable(path: Path | None, *, replaced: bool = False) -> None:
    """Refuses a place where no file can be written, before the work whose result it is for. Raises UsageError.

    replaced: a new file takes its place (`persistence.replace`), which the folder must allow, whatever the old one does.
    """
    if path is None:
        return
    folder = path.parent
    if path.is_dir():
        raise UsageError(f"{path}: is a folder, must be a file")
    if not folder.is_dir():
        raise UsageError(f"{path}: cannot be written: there is no folder {folder}")
    if not os.access(path if path.exists() and not replaced else folder, os.W_OK):
        raise UsageError(f"{path}: cannot be written: permission denied")


def apart(outputs: Mapping[str, Path | None], inputs: Mapping[str, Path | str | None]) -> None:
    """Refuses an output that would take the place of a file that is read, or of another output. Raises UsageError.

    outputs: option -> path. inputs: what a file is, in words -> path (or a name that is no file's).
    """
    read = {what: Path(path) for what, path in inputs.items() if path is not None}
    for option, path in outputs.items():
        if path is None:
            continue
        for what, other in read.items():
            if _same_file(path, other):
                raise UsageError(f"{option} {path}: is {what}, which would be lost; name another file")
        read[f"the file of {option}"] = path


def own_file(spec: ModelSpec) -> str | None:
    """The Python file that a model is in, if it is user-defined: a TOML or a profile may name it."""
    return spec.name if spec.name.endswith(".py") else None


def _same_file(one: Path, other: Path) -> bool:
    """Whether writing to one changes the other. A device (/dev/null) takes any number of writers."""
    if one.exists() and other.exists():
        return one.is_file() and one.samefile(other)
    return one.resolve() == other.resolve()
