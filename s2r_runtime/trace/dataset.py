"""The path that earlier versions documented for from_arrays; it goes with the next version."""

import warnings

from s2r_runtime.trace.data.dataset import from_arrays

__all__ = ["from_arrays"]

warnings.warn("s2r_runtime.trace.dataset has moved: import from_arrays from s2r_runtime.trace", DeprecationWarning, stacklevel=2)
