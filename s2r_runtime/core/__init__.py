"""The deterministic heart: `handle(state, event) -> (state, outputs)`, and what it is made of."""

from s2r_runtime.core.reducer import handle, initial, status

__all__ = ["handle", "initial", "status"]
