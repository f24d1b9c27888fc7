"""Quantitative semantics of signal temporal logic (Donze and Maler 2010), for many traces at once: >= 0 iff the trace satisfies it.

    a < b, a <= b     b - a               not p            -p
    a > b, a >= b     a - b               p and q          min(p, q)
    a == b            -|a - b|            p or q           max(p, q)
    a != b            |a - b|             p implies q      max(-p, q)
    always[a, b] p    min over [k + a, k + b]           eventually[a, b] p    max over it
    p until[a, b] q   max over t in [k + a, k + b] of min(q at t, min of p over [k, t))

Intervals are cut off at the end of the trace; over nothing, `always` is +inf and `eventually` is -inf. (At exactly 0 the sign does not
tell `<` from `<=`.) A value that is no number stays none, so that it counts as a violation.

A formula is taken apart: its *leaves* say something of one instant and are evaluated while the trace comes, (n,) each; what
is above them is evaluated over the whole trace, O(T) an operator.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.tasks.stl import windows
from s2r_runtime.tasks.stl.functions import FUNCTIONS, OPERATORS
from s2r_runtime.tasks.stl.syntax import (
    Always,
    And,
    Apply,
    Compare,
    Eventually,
    Expression,
    Name,
    Not,
    Number,
    Or,
    Truth,
    Until,
    is_instant,
    reach,
)
from s2r_runtime.tasks.stl.text import parse_truth

Array = NDArray[np.float64]
Signals = Mapping[str, Any]
Evaluate = Callable[[Signals], Any]
OfTrace = Callable[[list[Array], int], Array]
"""(leaves, (T, n) each; for how many samples from the first) -> (that many, n)."""

TOGETHER = 250
"""Runs at a time: what an operator leaves for the next then stays in a core's second-level cache."""


class Formula:
    """A formula over named signals, for samples dt s apart."""

    def __init__(self, truth: Truth, text: str = "") -> None:
        self.truth, self.text = truth, text
        self.reach = reach(truth)
        """Samples ahead of the first that its bounded intervals look."""
        self._instant = is_instant(truth)
        self._leaves: list[Evaluate] = []
        self._above = self._of_trace(truth)

    @classmethod
    def parse(cls, text: str, names: Collection[str], dt: float, where: str = "formula") -> Formula:
        """Raises ConfigError `where, column 5: ...`."""
        return cls(parse_truth(text, names, dt, where), text)

    @property
    def width(self) -> int:
        """How many leaves it has."""
        return len(self._leaves)

    def leaves(self, signals: Signals, n: int) -> tuple[Array, ...]:
        """Its leaves at one instant, (n,) each. signals: name -> (n,) or a number."""
        with np.errstate(all="ignore"):
            return tuple(np.broadcast_to(np.asarray(leaf(signals), dtype=np.float64), (n,)) for leaf in self._leaves)

    def of_leaves(self, leaves: list[Array], count: int = 1) -> Array:
        """Robustness at the first `count` samples, (count, n). leaves: (T, n) each."""
        count, n = min(count, len(leaves[0])), leaves[0].shape[1]
        with np.errstate(all="ignore"):
            if n <= TOGETHER or self._instant:
                return self._above(leaves, count)
            parts = [self._above([leaf[:, k : k + TOGETHER] for leaf in leaves], count) for k in range(0, n, TOGETHER)]
        return np.concatenate(parts, axis=1)

    def robustness(self, signals: Signals, *, whole: bool = False) -> Array:
        """Of traces: name -> (T, n), (n,) or a number, at least one of them (T, n). At the first sample, (n,); whole: at all, (T, n)."""
        shape = np.broadcast_shapes(*(np.shape(value) for value in signals.values()))
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"the signals have shape {shape}, must be (T, n)")
        with np.errstate(all="ignore"):
            leaves = [np.broadcast_to(np.asarray(leaf(signals), dtype=np.float64), shape) for leaf in self._leaves]
        found = self.of_leaves(leaves, shape[0] if whole else 1)
        return found if whole else np.asarray(found[0])

    def _of_trace(self, node: Truth) -> OfTrace:
        if is_instant(node):
            index = len(self._leaves)
            self._leaves.append(compile_truth(node))
            return lambda leaves, count: leaves[index][:count]
        match node:
            case Not():
                part = self._of_trace(node.part)
                return lambda leaves, count: -part(leaves, count)
            case And() | Or():
                join = np.minimum if isinstance(node, And) else np.maximum
                left, right = self._of_trace(node.left), self._of_trace(node.right)
                return lambda leaves, count: np.asarray(join(left(leaves, count), right(leaves, count)))
            case Always() | Eventually():
                kind: Literal["min", "max"] = "min" if isinstance(node, Always) else "max"
                inner, first, last = self._of_trace(node.part), node.first, node.last
                return lambda leaves, count: _extremum(kind, inner, leaves, first, last, count)
            case Until():
                left, right, first, last = self._of_trace(node.left), self._of_trace(node.right), node.first, node.last
                return lambda leaves, count: _until(left, right, leaves, first, last, count)
        raise AssertionError(node)  # a comparison is an instant


def _extremum(kind: Literal["min", "max"], part: OfTrace, leaves: list[Array], first: int, last: int | None, count: int) -> Array:
    steps = len(leaves[0])
    x = part(leaves, steps if last is None else min(steps, count + last))
    if count > 1:
        return windows.ahead(kind, x, first, last, count)
    within = x[first:] if last is None else x[first : last + 1]  # at the first sample alone there is nothing to slide
    reduce = np.minimum.reduce if kind == "min" else np.maximum.reduce
    return np.asarray(reduce(within, axis=0, initial=np.inf if kind == "min" else -np.inf))[None]


def _until(left: OfTrace, right: OfTrace, leaves: list[Array], first: int, last: int | None, count: int) -> Array:
    steps = len(leaves[0])
    needed = steps if last is None else min(steps, count + last)
    return windows.until(left(leaves, needed), right(leaves, needed), first, last, count)


def compile_truth(node: Truth) -> Evaluate:
    """Robustness at one instant, of a truth without intervals."""
    match node:
        case Compare():
            left, right, operator = compile_expression(node.left), compile_expression(node.right), node.operator
            if operator in {"<", "<="}:
                return lambda s: right(s) - left(s)
            if operator in {">", ">="}:
                return lambda s: left(s) - right(s)
            sign = -1.0 if operator == "==" else 1.0
            return lambda s: sign * np.abs(left(s) - right(s))
        case Not():
            part = compile_truth(node.part)
            return lambda s: -part(s)
        case And() | Or():
            join = np.minimum if isinstance(node, And) else np.maximum
            one, other = compile_truth(node.left), compile_truth(node.right)
            return lambda s: join(one(s), other(s))
        case _:
            raise AssertionError(node)


def compile_expression(node: Expression) -> Evaluate:
    """A number at one instant."""
    match node:
        case Number():
            value = np.float64(node.value)
            return lambda s: value
        case Name():
            name = node.name
            return lambda s: s[name]
        case Apply():
            arguments = [compile_expression(argument) for argument in node.arguments]
    if len(arguments) == 1:
        only = arguments[0]
        if node.function == "-":
            return lambda s: -only(s)
        function = FUNCTIONS[node.function].apply
        return lambda s: function(only(s))
    if node.function == "-":
        one, other = arguments
        return lambda s: one(s) - other(s)
    apply = OPERATORS.get(node.function) or FUNCTIONS[node.function].apply
    return lambda s: apply(*(argument(s) for argument in arguments))
