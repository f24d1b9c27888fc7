"""What all results share: one line, an account, plain data, HTML for notebooks, and axes for plots."""

from __future__ import annotations

import html
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.printable import printable_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER, MEASURED, LIMIT = "#d9822b", "#2f6db3", "#1b2330", "#c23030"
"""Colours of plots: the model as given, the repaired one, measurements, bounds."""


class Result(ABC):
    """A frozen result. `print(result)` shows `summary()`; a notebook shows it as HTML."""

    @abstractmethod
    def summary(self) -> str:
        """The account that the command line prints."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain data, as the command line prints it with `--json` (docs/json.md). Numbers in SI units and radians."""

    def __str__(self) -> str:
        return printable_lines(self.summary())

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {str(self).partition(chr(10))[0]}>"

    def _repr_html_(self) -> str:
        head, _, rest = str(self).partition("\n")
        body = f"<pre>{html.escape(rest)}</pre>" if rest else ""
        return f"<div><p><strong>{html.escape(head)}</strong></p>{body}</div>"


def axes_of(number: int, ax: Axes | None = None, *, height_in: float = 2.4) -> list[Axes]:
    """Axes below each other, in a new figure of pyplot's. ax: used instead, where one is needed. Raises ConfigError without matplotlib."""
    if ax is not None:
        return [ax]
    try:
        from matplotlib import pyplot
    except ImportError:
        raise ConfigError("plots need matplotlib: pip install 's2r-runtime[report]'") from None
    _, axes = pyplot.subplots(number, 1, figsize=(7.5, height_in * number + 0.6), squeeze=False, layout="constrained")
    return [axes[k, 0] for k in range(number)]


def labelled(name: str, unit: str) -> str:
    """`v (m/s)`."""
    return f"{name} ({unit})" if unit else name
