"""Embedded runtime assurance for robots.

`import s2r_runtime as s2r` gives the functions of docs/python.md: `s2r.model`, `s2r.recording`, `s2r.gap`, `s2r.trace`, `s2r.verify`,
`s2r.certify`, `s2r.audit`, `s2r.read_log` and `s2r.connect`. The command line uses the same functions. Each is imported when it is first
used (PEP 562), so the import itself loads nothing.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from s2r_runtime.moved import MovedModules

if TYPE_CHECKING:
    from s2r_runtime.api.certification import Certification, certify
    from s2r_runtime.api.gaps import GapResult, gap
    from s2r_runtime.api.live import Answer, Daemon, connect
    from s2r_runtime.api.logs import Audit, Log, audit, read_log
    from s2r_runtime.api.models import Model, model
    from s2r_runtime.api.progress import Step
    from s2r_runtime.api.recordings import Recording, recording
    from s2r_runtime.api.tracing import Trace, trace
    from s2r_runtime.api.verification import VerifyResult, verify
    from s2r_runtime.errors import ConfigError, ControllerError, NotEnoughEvidence, PluginError, RecordingError, S2RError, UsageError

__all__ = [
    "Answer", "Audit", "Certification", "ConfigError", "ControllerError", "Daemon", "GapResult", "Log", "Model", "NotEnoughEvidence",
    "PluginError", "Recording", "RecordingError", "S2RError", "Step", "Trace", "UsageError", "VerifyResult", "audit", "certify", "connect",
    "gap", "model", "read_log", "recording", "trace", "verify",
]  # fmt: skip

_HOME = {
    **dict.fromkeys(("Certification", "certify"), "api.certification"),
    **dict.fromkeys(("GapResult", "gap"), "api.gaps"),
    **dict.fromkeys(("Answer", "Daemon", "connect"), "api.live"),
    **dict.fromkeys(("Audit", "Log", "audit", "read_log"), "api.logs"),
    **dict.fromkeys(("Model", "model"), "api.models"),
    "Step": "api.progress",
    **dict.fromkeys(("Recording", "recording"), "api.recordings"),
    **dict.fromkeys(("Trace", "trace"), "api.tracing"),
    **dict.fromkeys(("VerifyResult", "verify"), "api.verification"),
    **dict.fromkeys(
        ("ConfigError", "ControllerError", "NotEnoughEvidence", "PluginError", "RecordingError", "S2RError", "UsageError"), "errors"
    ),
}
"""Public name -> module that has it."""


class _Package(ModuleType):
    """Keeps the functions `gap`, `trace`, `verify`, `audit` and `recording` where they are.

    Some submodules have the same names, and importing one would put it in the function's place. `from s2r_runtime.trace import ...` finds
    the submodule all the same.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
sys.meta_path.insert(0, MovedModules())


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used. Raises AttributeError for any other."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
