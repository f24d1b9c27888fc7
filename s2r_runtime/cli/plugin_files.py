"""The packages that `s2r plugin new` writes: files in `testing/templates/KIND`, with the name filled in. Tests run them."""

from __future__ import annotations

import importlib.util
import keyword
import re
import shutil
import sys
from pathlib import Path

from s2r_runtime.errors import UsageError

TEMPLATES = Path(__file__).parent.parent / "testing" / "templates"
KINDS = ("transport", "model", "effect", "task", "recording", "controller")
NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
OFFERED = {"transport": "transports", "model": "models", "effect": "effects", "task": "tasks"}
"""Kinds whose offer has the plug-in's name."""


def write(name: str, kind: str, folder: Path) -> list[Path]:
    """Writes the package into a new folder; returns its files. Raises UsageError for a name that can't be, or a folder that is there."""
    _usable(name, kind)
    if folder.exists() or folder.is_symlink():
        raise UsageError(f"{folder}: is there already; name another folder with --to, or another plug-in")
    camel = "".join(word.capitalize() for word in name.split("_"))
    written = []
    try:
        folder.mkdir(parents=True)
        for template in sorted((TEMPLATES / kind).rglob("*")):
            if template.is_dir() or "__pycache__" in template.parts:
                continue
            path = folder / str(template.relative_to(TEMPLATES / kind)).replace("my_thing", name)
            path.parent.mkdir(parents=True, exist_ok=True)
            text = template.read_text(encoding="utf-8")
            path.write_text(text.replace("my_thing", name).replace("MyThing", camel).replace("my-thing", name.replace("_", "-")), "utf-8")
            written.append(path)
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise UsageError(f"{folder}: cannot be written: {error.strerror}") from None
    return written


def _usable(name: str, kind: str) -> None:
    if not NAME.fullmatch(name):
        raise UsageError(f"NAME is {name!r}, must be a small letter, then small letters, digits and _, 40 at most")
    if keyword.iskeyword(name) or name in sys.stdlib_module_names or name in ("test", "tests"):
        raise UsageError(f"NAME is {name!r}, which Python uses itself; choose another")
    if kind == "controller":
        return
    from s2r_runtime.plugins import registry

    if (there := OFFERED.get(kind)) and name in registry().names(there):
        raise UsageError(f"NAME is {name!r}, but {registry().offered(there, name).distribution} has a {kind} of that name; choose another")
    if importlib.util.find_spec(name) is not None:
        raise UsageError(f"NAME is {name!r}, but a package of that name is installed here; choose another")
