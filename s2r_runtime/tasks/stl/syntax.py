"""What a formula is made of. Expressions are numbers at an instant; truths are formulas; intervals are whole samples.

    expression  Number, Name, Apply(function, arguments)
    truth       Compare, Not, And, Or                    at an instant
                Always, Eventually, Until                over an interval [first, last] of samples ahead; last None: to the trace's end

`column`: where it stands in the text, counted from 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float
    column: int = 0


@dataclass(frozen=True)
class Name:
    """A state, a name of the scenario, or `t`."""

    name: str
    column: int = 0


@dataclass(frozen=True)
class Apply:
    """A function of expressions, or an operator (`+ - * / ^`, unary `-` with one argument)."""

    function: str
    arguments: tuple[Expression, ...]
    column: int = 0


@dataclass(frozen=True)
class Compare:
    """left < right and so on."""

    operator: Literal["<", "<=", ">", ">=", "==", "!="]
    left: Expression
    right: Expression
    column: int = 0


@dataclass(frozen=True)
class Not:
    """It does not hold."""

    part: Truth
    column: int = 0


@dataclass(frozen=True)
class And:
    """Both hold."""

    left: Truth
    right: Truth
    column: int = 0


@dataclass(frozen=True)
class Or:
    """At least one holds. `a implies b` is `not a or b`."""

    left: Truth
    right: Truth
    column: int = 0


@dataclass(frozen=True)
class Always:
    """It holds at every sample of the interval."""

    first: int
    last: int | None
    part: Truth
    column: int = 0


@dataclass(frozen=True)
class Eventually:
    """It holds at some sample of the interval."""

    first: int
    last: int | None
    part: Truth
    column: int = 0


@dataclass(frozen=True)
class Until:
    """`right` holds at some sample of the interval, and `left` at every one from now to the one before that."""

    first: int
    last: int | None
    left: Truth
    right: Truth
    column: int = 0


Expression = Number | Name | Apply
Truth = Compare | Not | And | Or | Always | Eventually | Until
Temporal = Always | Eventually | Until


def parts(node: Truth) -> tuple[Truth, ...]:
    """The truths that a truth is made of."""
    match node:
        case Compare():
            return ()
        case Not() | Always() | Eventually():
            return (node.part,)
        case And() | Or() | Until():
            return (node.left, node.right)


def operands(node: Truth | Expression) -> tuple[Truth | Expression, ...]:
    """What stands right below a node, of either kind."""
    match node:
        case Number() | Name():
            return ()
        case Apply():
            return node.arguments
        case Compare():
            return (node.left, node.right)
        case _:
            return parts(node)


def is_instant(node: Truth) -> bool:
    """Whether it says something of one instant only."""
    return not isinstance(node, Always | Eventually | Until) and all(is_instant(part) for part in parts(node))


def reach(node: Truth) -> int:
    """How many samples ahead its bounded intervals look; one without an end counts with its beginning."""
    own = 0
    if isinstance(node, Always | Eventually | Until):
        own = node.first if node.last is None else node.last
    return own + max((reach(part) for part in parts(node)), default=0)


def positive(node: Truth, *, negated: bool = False) -> Truth:
    """The same with every `not` moved down to the comparisons (`not a until b` stays as it is: there is no operator for it)."""
    match node:
        case Not():
            return positive(node.part, negated=not negated)
        case And() | Or():
            kind = And if isinstance(node, And) != negated else Or
            return kind(positive(node.left, negated=negated), positive(node.right, negated=negated), node.column)
        case Always() | Eventually():
            turned = Always if isinstance(node, Always) != negated else Eventually
            return turned(node.first, node.last, positive(node.part, negated=negated), node.column)
        case Compare() | Until():
            return Not(node, node.column) if negated else node
