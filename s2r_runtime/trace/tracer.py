"""The path that earlier versions documented for load_dataset and trace; it goes with the next version."""

import warnings

from s2r_runtime.trace.pipeline import load_dataset, trace

__all__ = ["load_dataset", "trace"]

warnings.warn("s2r_runtime.trace.tracer has moved: import load_dataset, trace from s2r_runtime.trace", DeprecationWarning, stacklevel=2)
