"""Import paths of version 0.1 that documents showed. They load the module from its new place, with a warning, for one more version."""

from __future__ import annotations

import importlib
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {
    "certificate": "trust.certificate",
    "comparison": "evidence.comparison",
    "formats": "recordings.formats",
    "gap": "evidence.gap",
    "robot_logs": "recordings.robot_logs",
    "stl": "tasks.stl",
    "transitions": "recordings.loading",
    "uncertain": "evidence.uncertain",
    "units": "recordings.units",
    "verify": "evidence.verify",
}
"""Old name below `s2r_runtime` -> new one; what is inside moved with it."""


class MovedModules(MetaPathFinder, Loader):
    """Stands before the other finders: these would load a file below an old name a second time. Both names are one module."""

    def find_spec(self, fullname: str, _path: Any = None, _target: Any = None) -> ModuleSpec | None:
        """The spec of an old name; None of any other."""
        return ModuleSpec(fullname, self) if new_name(fullname) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module at its new place."""
        new = str(new_name(spec.name))
        warnings.warn(f"{spec.name} is now {new}; the old name goes with the next version", DeprecationWarning, stacklevel=2)
        module = importlib.import_module(new)
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: it ran at its new place. The import system gave it the alias's spec; it gets its own back."""
        if module.__spec__ is not None:
            module.__spec__ = module.__spec__.loader_state


def new_name(fullname: str) -> str | None:
    """`s2r_runtime.formats.sizes` -> `s2r_runtime.recordings.formats.sizes`; None if that name did not move."""
    package, _, rest = fullname.partition(".")
    old, dot, inside = rest.partition(".")
    return f"{package}.{MOVED[old]}{dot}{inside}" if package == "s2r_runtime" and old in MOVED else None
