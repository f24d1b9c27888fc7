"""Text -> formula. What is wrong with it is one line that says the column and what would be right.

    truth   a implies b (or ->)       weakest; to the right
            a or b (||, |)
            a and b (&&, &)
            a until[0,5] b
            not a (!), always[0,10] a, eventually[0,10] a
            e < e, <=, >, >=, ==, !=  and chains: 0 < x < 2
    number  e + e, e - e; e * e, e / e; -e; e ^ e (**)
            1.5, 1e-3, pi, names, f(e, ...), (e)

Intervals are in seconds and hold the samples k with first <= k dt <= last; one without an interval goes on to the trace's end.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection
from typing import Literal, cast

from s2r_runtime.errors import ConfigError
from s2r_runtime.tasks.stl.functions import FUNCTIONS
from s2r_runtime.tasks.stl.syntax import Always, And, Apply, Compare, Eventually, Expression, Name, Not, Number, Or, Truth, Until, operands
from s2r_runtime.tasks.stl.tokens import WORDS, Token, cut

LENGTH_MAX = 20_000
DEPTH_MAX = 40
"""Brackets within brackets; Python's own stack ends at 1000 calls, and each takes a dozen to read."""
TREE_MAX = 200
"""Operators within operators, so in a sum or product of so many terms too; each takes two calls to evaluate."""
ROUNDING = 1e-6
"""Of a step: decimal seconds are not exact multiples of dt."""

CONSTANTS = {"pi": math.pi}
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")


def parse_truth(text: str, names: Collection[str], dt: float, where: str) -> Truth:
    """A formula over these names, for samples dt s apart. Raises ConfigError `where, column 5: ...`."""
    parser = _Parser(text, names, dt, where)
    return parser.truth(parser.whole())


def parse_expression(text: str, names: Collection[str], where: str) -> Expression:
    """A number over these names. Raises ConfigError as `parse_truth`."""
    parser = _Parser(text, names, math.inf, where)
    return parser.number(parser.whole())


def parse_either(text: str, names: Collection[str], dt: float, where: str) -> Truth | Expression:
    """A formula or a number."""
    return _Parser(text, names, dt, where).whole()


class _Parser:
    def __init__(self, text: str, names: Collection[str], dt: float, where: str) -> None:
        self._names, self._dt, self._where = names, dt, where
        self._depth = 0
        if len(text) > LENGTH_MAX:
            raise ConfigError(f"{where}: has {len(text)} characters, a formula has at most {LENGTH_MAX}")
        self._tokens = cut(text, where)
        self._at = 0

    def whole(self) -> Truth | Expression:
        """All of the text."""
        if self._now.kind == "end":
            raise self._wrong(self._now, "is empty, must be a formula such as always (x < 2)")
        node = self._implies()
        rest = self._now
        if rest.kind != "end":
            raise self._wrong(rest, f"{rest.said} does not belong here; what stands before it is complete")
        self._check_depth(node)
        return node

    def truth(self, node: Truth | Expression, joined: str = "") -> Truth:
        """node, if it is one."""
        if isinstance(node, Number | Name | Apply):
            what = f"{joined!r} joins formulas and" if joined else "a formula is needed, and"
            raise self._error(node.column, f"{what} here stands a number; compare it with something, as in x > 0")
        return node

    def number(self, node: Truth | Expression, used: str = "") -> Expression:
        """node, if it is one."""
        if not isinstance(node, Number | Name | Apply):
            what = f"{used!r} takes numbers and" if used else "a number is needed, and"
            raise self._error(node.column, f"{what} here stands a formula")
        return node

    def _check_depth(self, whole: Truth | Expression) -> None:
        level: list[Truth | Expression] = [whole]
        for _ in range(TREE_MAX):
            level = [below for node in level for below in operands(node)]
        if level:
            raise self._error(level[0].column, f"is the operand of more than {TREE_MAX} operators, one within the other")

    # ---------------------------------------------------------------- tokens

    @property
    def _now(self) -> Token:
        return self._tokens[self._at]

    def _take(self, *texts: str) -> Token | None:
        if self._now.kind != "end" and self._now.text in texts and self._now.kind != "name":
            self._at += 1
            return self._tokens[self._at - 1]
        return None

    def _need(self, text: str, why: str) -> None:
        if self._take(text) is None:
            raise self._wrong(self._now, f"expected {text!r} {why}, found {self._now.said}")

    def _wrong(self, token: Token, what: str) -> ConfigError:
        return self._error(token.column, what)

    def _error(self, column: int, what: str) -> ConfigError:
        return ConfigError(f"{self._where}, column {column}: {what}")

    # ---------------------------------------------------------------- truths

    def _implies(self) -> Truth | Expression:
        left = self._or()
        if token := self._take("implies"):
            self._enter(token)
            right = self._implies()
            self._depth -= 1
            return Or(Not(self.truth(left, "implies"), token.column), self.truth(right, "implies"), token.column)
        return left

    def _or(self) -> Truth | Expression:
        first = self._and()
        joined: list[tuple[Truth, int]] = []
        while token := self._take("or"):
            joined.append((self.truth(self._and(), "or"), token.column))
        return _balanced(Or, [(self.truth(first, "or"), 0), *joined]) if joined else first

    def _and(self) -> Truth | Expression:
        first = self._until()
        joined: list[tuple[Truth, int]] = []
        while token := self._take("and"):
            joined.append((self.truth(self._until(), "and"), token.column))
        return _balanced(And, [(self.truth(first, "and"), 0), *joined]) if joined else first

    def _until(self) -> Truth | Expression:
        left = self._unary()
        while token := self._take("until"):
            first, last = self._interval(token)
            left = Until(first, last, self.truth(left, "until"), self.truth(self._unary(), "until"), token.column)
        return left

    def _unary(self) -> Truth | Expression:
        token = self._take("not", "always", "eventually")
        if token is None:
            return self._comparison()
        self._enter(token)
        if token.text == "not":
            node: Truth = Not(self.truth(self._unary(), "not"), token.column)
        else:
            first, last = self._interval(token)
            kind = Always if token.text == "always" else Eventually
            node = kind(first, last, self.truth(self._unary(), token.text), token.column)
        self._depth -= 1
        return node

    def _interval(self, of: Token) -> tuple[int, int | None]:
        """[a, b] in s as samples; without one: from now to the end."""
        opened = self._take("[")
        if opened is None:
            return 0, None
        a, first = self._bound(of)
        if self._take(",", ":") is None:
            raise self._wrong(self._now, f"expected ',' between the bounds of {of.text}, found {self._now.said}")
        b, last = self._bound(of)
        self._need("]", f"after the bounds of {of.text}")
        if b < a:
            raise self._error(opened.column, f"the interval of {of.text} ends before it begins: [{a:g}, {b:g}]")
        if last < first:
            raise self._error(opened.column, f"the interval [{a:g}, {b:g}] s of {of.text} holds no sample of a step of {self._dt:g} s")
        return first, last

    def _bound(self, of: Token) -> tuple[float, int]:
        token = self._now
        if token.kind != "number":
            raise self._wrong(token, f"the bounds of {of.text} are seconds, numbers >= 0; found {token.said}")
        self._at += 1
        value = float(token.text)
        steps = value / self._dt
        if not steps < 2**31:
            raise self._wrong(token, f"{token.text} s is too long")
        upper = self._tokens[self._at].text == "]"
        return value, math.floor(steps + ROUNDING) if upper else math.ceil(steps - ROUNDING)

    def _comparison(self) -> Truth | Expression:
        left = self._sum()
        chain: list[Truth] = []
        while token := self._take(*_COMPARISONS):
            right = self._sum()
            operator = cast("Literal['<', '<=', '>', '>=', '==', '!=']", token.text)
            chain.append(Compare(operator, self.number(left, token.text), self.number(right, token.text), token.column))
            left = right
        if not chain:
            return left
        node = chain[0]
        for further in chain[1:]:
            node = And(node, further, further.column)
        return node

    # ---------------------------------------------------------------- numbers

    def _sum(self) -> Truth | Expression:
        left = self._product()
        while token := self._take("+", "-"):
            left = Apply(token.text, (self.number(left, token.text), self.number(self._product(), token.text)), token.column)
        return left

    def _product(self) -> Truth | Expression:
        left = self._signed()
        while token := self._take("*", "/"):
            left = Apply(token.text, (self.number(left, token.text), self.number(self._signed(), token.text)), token.column)
        return left

    def _signed(self) -> Truth | Expression:
        token = self._take("-", "+")
        if token is None:
            return self._power()
        self._enter(token)
        inner = self.number(self._signed(), token.text)
        self._depth -= 1
        return inner if token.text == "+" else Apply("-", (inner,), token.column)

    def _power(self) -> Truth | Expression:
        base = self._atom()
        token = self._take("^")
        if token is None:
            return base
        self._enter(token)
        exponent = self.number(self._signed(), "^")
        self._depth -= 1
        return Apply("^", (self.number(base, "^"), exponent), token.column)

    def _atom(self) -> Truth | Expression:
        token = self._now
        if token.kind == "number":
            self._at += 1
            return Number(float(token.text), token.column)
        if token.kind == "name":
            self._at += 1
            return self._call(token) if self._now.text == "(" and self._now.kind == "sign" else self._named(token)
        if self._take("("):
            self._enter(token)
            node = self._implies()
            self._need(")", f"for the bracket at column {token.column}")
            self._depth -= 1
            return node
        raise self._wrong(token, f"expected a name, a number or '(', found {token.said}")

    def _named(self, token: Token) -> Expression:
        if token.text in self._names:
            return Name(token.text, token.column)
        if token.text in CONSTANTS:
            return Number(CONSTANTS[token.text], token.column)
        if token.text in FUNCTIONS:
            raise self._wrong(token, f"{token.text} is a function: {token.text}(...)")
        near = difflib.get_close_matches(token.text, [*self._names, *WORDS], 1, 0.6)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(self._names)}"
        raise self._wrong(token, f"{token.text!r} is not known; {hint}")

    def _call(self, token: Token) -> Expression:
        function = FUNCTIONS.get(token.text)
        if function is None:
            near = difflib.get_close_matches(token.text, [*FUNCTIONS, *WORDS], 1, 0.6)
            hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(FUNCTIONS)}"
            raise self._wrong(token, f"{token.text!r} is no function; {hint}")
        self._enter(token)
        self._need("(", "")
        arguments = [self.number(self._sum(), token.text)]
        while self._take(","):
            arguments.append(self.number(self._sum(), token.text))
        self._need(")", f"after the arguments of {token.text}")
        self._depth -= 1
        low, high = function.arity
        if not low <= len(arguments) <= high:
            must = f"{low}" if low == high else f"{low} or more"
            raise self._wrong(token, f"{token.text} has {len(arguments)} arguments, must have {must}")
        return Apply(token.text, tuple(arguments), token.column)

    def _enter(self, token: Token) -> None:
        self._depth += 1
        if self._depth > DEPTH_MAX:
            raise self._wrong(token, f"is nested deeper than {DEPTH_MAX} levels")


def _balanced(kind: type[And | Or], joined: list[tuple[Truth, int]]) -> Truth:
    """Hundreds of them, and the tree stays shallow: minima and maxima are the same in any order. joined: each with the column of the word
    before it.
    """
    if len(joined) == 1:
        return joined[0][0]
    middle = (len(joined) + 1) // 2
    return kind(_balanced(kind, joined[:middle]), _balanced(kind, joined[middle:]), joined[middle][1])
