"""Units as DBC files write them: those of the runtime (`s2r_runtime.recordings.units`)."""

from __future__ import annotations

from s2r_runtime.recordings.units import FACTORS, factor_of

__all__ = ["FACTORS", "factor_of"]
