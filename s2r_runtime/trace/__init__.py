"""From the residual to the effect that a model lacks, and the error before and after.

`pipeline` runs a trace, `assemble` makes its result, `verdict` decides. Folders import one way, from the last to the first (pyproject.toml
lists what does not yet): data, estimation, checks and sensor_faults, hypotheses, selection, diagnostics, reporting, design.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from s2r_runtime.trace.version import VERSION

if TYPE_CHECKING:
    from s2r_runtime.trace.data.dataset import Dataset, from_arrays
    from s2r_runtime.trace.data.readers import load_dataset
    from s2r_runtime.trace.design.suggest import suggest
    from s2r_runtime.trace.pipeline import trace
    from s2r_runtime.trace.reporting.result import TraceResult

__all__ = ["VERSION", "Dataset", "TraceResult", "from_arrays", "load_dataset", "suggest", "trace"]

_HOME = {
    "Dataset": "data.dataset",
    "TraceResult": "reporting.result",
    "from_arrays": "data.dataset",
    "load_dataset": "data.readers",
    "suggest": "design.suggest",
    "trace": "pipeline",
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used: who needs the version alone loads no numerical library."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
