"""Where a repaired model was fitted or judged: the range of every state and input in which all but a hundredth of its transitions lie, each
by itself: what was seen together is less.

Friction that was found on one carpet, or at one speed, need not be there on another: beyond these ranges nothing that was measured speaks
for what was found. An angle's range is the shortest arc that holds as many; none is told where that leaves out next to nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Steps, acting

Array = NDArray[np.float64]

BEYOND = 0.01
"""Share of the transitions that may lie outside: outliers are none of where a robot was."""

ONE = 1e-9
"""Of a value: a range that is no wider is that value."""

ALL_ROUND = math.pi / 18.0
"""rad: an arc that leaves out less goes all round."""


@dataclass(frozen=True)
class Range:
    """low, high: of a state or input, in its unit; of an angle low is in (-pi, pi], high may be beyond pi, and both are None all round."""

    name: str
    low: float | None
    high: float | None
    unit: str

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {"low": self.low, "high": self.high, "unit": self.unit}

    def text(self) -> str:
        """`x from -1 to 2.5 m`."""
        if self.low is None or self.high is None:
            return f"{self.name} all round"
        unit = f" {self.unit}" if self.unit else ""
        span = self.high - self.low
        if span <= ONE * max(abs(self.low), abs(self.high)):
            return f"{self.name} {self.low:.6g}{unit} only"
        places = max(2 - math.floor(math.log10(span)), 0)  # to a hundredth of the span: 0, not -0.000709, where the other end is 1
        low, high = (_short(f"{round(end, places) + 0.0:.{places}f}") for end in (self.low, self.high))
        return f"{self.name} from {low} to {high}{unit}"


def domain_of(model: ComposedModel, *seen: tuple[Dataset, Steps]) -> tuple[Range, ...]:
    """Of every state of a model as given, then every input, as it was asked, over all transitions seen: those that
    were fitted, and those judged on.
    """
    units = getattr(model.nominal, "units", {})
    states = np.concatenate([steps.y0 for _, steps in seen])
    asked = np.concatenate([acting(model, data, ()).mean[steps.place] for data, steps in seen])

    def ranges() -> Iterator[Range]:
        for name, y in zip(model.states, states.T, strict=True):
            low, high = _arc(y) if name in model.nominal.angles else _span(y)
            yield Range(name, low, high, units.get(name, ""))
        for name, u in zip(model.inputs, asked.T, strict=True):
            yield Range(name, *_span(u), units.get(name, ""))

    return tuple(ranges())


def _short(number: str) -> str:
    """Without zeros that say nothing."""
    return number.rstrip("0").rstrip(".") if "." in number else number


def told(ranges: Sequence[Range]) -> str:
    """One line."""
    return ", ".join(one.text() for one in ranges)


def _span(values: Array) -> tuple[float, float]:
    """All but half of BEYOND at either end."""
    low, high = np.quantile(values, [0.5 * BEYOND, 1.0 - 0.5 * BEYOND])
    return float(low), float(high)


def _arc(angles: Array) -> tuple[float | None, float | None]:
    """(from, to) of the shortest arc that holds all but BEYOND of them, counterclockwise; None, if it goes all round."""
    at = np.sort(np.remainder(angles, math.tau))
    held = math.ceil((1.0 - BEYOND) * len(at))
    ends = np.concatenate([at, at + math.tau])[held - 1 : held - 1 + len(at)]
    k = int(np.argmin(ends - at))
    if ends[k] - at[k] > math.tau - ALL_ROUND:
        return None, None
    begin = math.remainder(float(at[k]), math.tau)
    return begin, begin + float(ends[k] - at[k])
