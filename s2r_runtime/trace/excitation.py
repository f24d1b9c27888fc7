"""The path that earlier versions documented for suggest; it goes with the next version."""

import warnings

from s2r_runtime.trace.design.suggest import suggest

__all__ = ["suggest"]

warnings.warn("s2r_runtime.trace.excitation has moved: import suggest from s2r_runtime.trace", DeprecationWarning, stacklevel=2)
