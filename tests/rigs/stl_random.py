"""Random formulas and traces, and the semantics written down once more, as naively as it can be: one value at a time, by recursion.

A formula is a nested tuple. `text` writes it as the runtime reads it, `rtamt_text` as RTAMT does, `naive` is its robustness at sample k of
one trace {name: [values]}.
"""

from __future__ import annotations

import math
import random
from typing import Any

NAMES = ("x", "y", "z")
OPERATORS = ("<", "<=", ">", ">=")
Node = tuple[Any, ...]


def random_expression(rng: random.Random, depth: int) -> Node:
    """Sums, differences, products and functions of the names and of constants."""
    kind = rng.choice(("name", "name", "number", "+", "-", "*", "abs")) if depth else rng.choice(("name", "number"))
    if kind == "name":
        return ("name", rng.choice(NAMES))
    if kind == "number":
        return ("number", round(rng.uniform(-2.0, 2.0), 2))
    if kind == "abs":
        return ("abs", random_expression(rng, depth - 1))
    return (kind, random_expression(rng, depth - 1), random_expression(rng, depth - 1))


def random_formula(rng: random.Random, depth: int, longest: int = 9) -> Node:
    """Of all operators; intervals of up to `longest` samples, or without bounds."""
    if depth == 0 or rng.random() < 0.1:
        return ("compare", rng.choice(OPERATORS), random_expression(rng, 2), random_expression(rng, 1))
    kind = rng.choice(("not", "and", "or", "implies", "always", "eventually", "until"))
    if kind == "not":
        return (kind, random_formula(rng, depth - 1, longest))
    if kind in {"and", "or", "implies"}:
        return (kind, random_formula(rng, depth - 1, longest), random_formula(rng, depth - 1, longest))
    interval = None if rng.random() < 0.3 else tuple(sorted((rng.randint(0, longest), rng.randint(0, longest))))
    if kind == "until":
        return (kind, interval, random_formula(rng, depth - 1, longest), random_formula(rng, depth - 1, longest))
    return (kind, interval, random_formula(rng, depth - 1, longest))


def expression_text(node: Node) -> str:
    """Fully bracketed."""
    match node:
        case ("name", name):
            return str(name)
        case ("number", value):
            return f"({value})"
        case ("abs", part):
            return f"abs({expression_text(part)})"
        case (operator, left, right):
            return f"({expression_text(left)} {operator} {expression_text(right)})"
    raise AssertionError(node)


def text(node: Node, dt: float = 1.0) -> str:
    """As the runtime reads it; intervals in seconds."""
    match node:
        case ("compare", operator, left, right):
            return f"({expression_text(left)} {operator} {expression_text(right)})"
        case ("not", part):
            return f"(not {text(part, dt)})"
        case ("and" | "or" | "implies" as kind, left, right):
            return f"({text(left, dt)} {kind} {text(right, dt)})"
        case ("until", interval, left, right):
            return f"({text(left, dt)} until{_bounds(interval, dt)} {text(right, dt)})"
        case (kind, interval, part):
            return f"({kind}{_bounds(interval, dt)} {text(part, dt)})"
    raise AssertionError(node)


def rtamt_text(node: Node) -> str:
    """As RTAMT reads it, for samples 1 s apart: negative numbers as differences, brackets around every operand."""
    match node:
        case ("compare", operator, left, right):
            return f"({_rtamt_expression(left)} {operator} {_rtamt_expression(right)})"
        case ("not", part):
            return f"(not({rtamt_text(part)}))"
        case ("and" | "or" as kind, left, right):
            return f"({rtamt_text(left)} {kind} {rtamt_text(right)})"
        case ("implies", left, right):
            return f"({rtamt_text(left)} -> {rtamt_text(right)})"
        case ("until", interval, left, right):
            return f"({rtamt_text(left)} until{_bounds(interval, 1.0)} {rtamt_text(right)})"
        case (kind, interval, part):
            return f"({kind}{_bounds(interval, 1.0)}({rtamt_text(part)}))"
    raise AssertionError(node)


def _rtamt_expression(node: Node) -> str:
    match node:
        case ("name", name):
            return str(name)
        case ("number", value):
            return f"({value})" if value >= 0.0 else f"(0 - {-value})"
        case ("abs", part):
            return f"abs({_rtamt_expression(part)})"
        case (operator, left, right):
            return f"({_rtamt_expression(left)} {operator} {_rtamt_expression(right)})"
    raise AssertionError(node)


def _bounds(interval: tuple[int, int] | None, dt: float) -> str:
    return "" if interval is None else f"[{interval[0] * dt:.9g},{interval[1] * dt:.9g}]"


def naive(node: Node, trace: dict[str, list[float]], k: int) -> float:
    """Robustness at sample k, by the definition."""
    steps = len(trace["x"])
    match node:
        case ("compare", operator, left, right):
            a, b = value(left, trace, k), value(right, trace, k)
            return b - a if operator in {"<", "<="} else a - b
        case ("not", part):
            return -naive(part, trace, k)
        case ("and", left, right):
            return min(naive(left, trace, k), naive(right, trace, k))
        case ("or", left, right):
            return max(naive(left, trace, k), naive(right, trace, k))
        case ("implies", left, right):
            return max(-naive(left, trace, k), naive(right, trace, k))
        case ("always", interval, part):
            return min((naive(part, trace, j) for j in _within(interval, k, steps)), default=math.inf)
        case ("eventually", interval, part):
            return max((naive(part, trace, j) for j in _within(interval, k, steps)), default=-math.inf)
        case ("until", interval, left, right):
            return max(
                (min([naive(right, trace, j), *(naive(left, trace, i) for i in range(k, j))]) for j in _within(interval, k, steps)),
                default=-math.inf,
            )
    raise AssertionError(node)


def value(node: Node, trace: dict[str, list[float]], k: int) -> float:
    """An expression at sample k."""
    match node:
        case ("name", name):
            return trace[name][k]
        case ("number", number):
            return number
        case ("abs", part):
            return abs(value(part, trace, k))
        case ("+", left, right):
            return value(left, trace, k) + value(right, trace, k)
        case ("-", left, right):
            return value(left, trace, k) - value(right, trace, k)
        case ("*", left, right):
            return value(left, trace, k) * value(right, trace, k)
    raise AssertionError(node)


def _within(interval: tuple[int, int] | None, k: int, steps: int) -> range:
    first, last = (0, steps) if interval is None else interval
    return range(k + first, min(k + last + 1, steps))


def rtamt_robustness(node: Node, trace: dict[str, list[float]]) -> list[float]:
    """RTAMT's robustness at every sample. Imports rtamt."""
    import rtamt

    spec = rtamt.StlDiscreteTimeSpecification()
    for name in NAMES:
        spec.declare_var(name, "float")
    spec.spec = rtamt_text(node)
    spec.parse()
    steps = len(trace["x"])
    found = spec.evaluate({"time": list(range(steps)), **{name: list(trace[name]) for name in NAMES}})
    return [float(v) for _, v in found]
