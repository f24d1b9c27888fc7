"""Mutants of a Python module: every small change of its code that a test should notice. Pure; `tools/mutation.py` runs them.

    comparison    a < b -> a <= b, a >= b          a == b -> a != b         a is b, a in b -> their opposites
    logic         a and b -> a or b, a, b          not a -> a               if a -> if True, if False      while a -> while False
    arithmetic    a + b <-> a - b                  a * b <-> a / b          -a -> a, and so on;  min <-> max, any <-> all
    constants     n -> n + 1, 0.5 -> 1.0           True <-> False           "word" -> another, "" -> a word
    statements    a call, an assignment to what exists already, a raise is removed;  return a -> return None
    parts         a keyword argument, a filter of a comprehension, an arm or guard of `match`, a caught exception is left out

Not changed: docstrings, annotations, imports, `__all__`, decorators, and prose (a text with a space in it, and what stands between the
braces of an f-string): what a sentence says to people is held by the tests of those sentences, where it matters.

A mutant is named by its place and its change, not by a line number, so that its name stays while other lines come and go.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from types import CodeType
from typing import Any

Path = tuple[tuple[str, int | None], ...]
"""Where a node is: (field, index in it if that is a list), from a top-level statement down."""

ORDER: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
OPPOSITE = {"min": "max", "max": "min", "any": "all", "all": "any"}
SHOWN = 90
"""Characters of a change that a name holds."""


@dataclass(frozen=True)
class Mutant:
    """`module`: as gate.py; `where`: the function or method, empty at module level. lines: of what is changed, first and last."""

    module: str
    where: str
    change: str
    lines: tuple[int, int]
    top: ast.stmt
    path: Path
    new: Any
    """What stands there instead; None: nothing."""

    @property
    def name(self) -> str:
        """What `--only` looks into, and what is printed."""
        return f"{self.module}:{self.where or '<module>'}: {self.change}"

    def mutated(self) -> ast.stmt:
        """The top-level statement with the change."""
        top = copy.deepcopy(self.top)
        node: Any = top
        for field, index in self.path[:-1]:
            node = getattr(node, field) if index is None else getattr(node, field)[index]
        field, index = self.path[-1]
        if index is None:
            setattr(node, field, self.new)
        elif self.new is None:
            del getattr(node, field)[index]
        else:
            getattr(node, field)[index] = self.new
        return ast.fix_missing_locations(top)

    def code(self, filename: str) -> CodeType:
        """The changed function's code."""
        future = ast.ImportFrom("__future__", [ast.alias("annotations")], 0)
        compiled = compile(ast.fix_missing_locations(ast.Module([future, self.mutated()], [])), filename, "exec")
        for part in self.where.split("."):
            compiled = next(one for one in compiled.co_consts if isinstance(one, CodeType) and one.co_name == part)
        return compiled

    def statement_code(self, filename: str) -> CodeType:
        """The changed top-level statement's code, to be run in its module."""
        future = ast.ImportFrom("__future__", [ast.alias("annotations")], 0)
        return compile(ast.fix_missing_locations(ast.Module([future, self.mutated()], [])), filename, "exec")

    def module_code(self, tree: ast.Module, filename: str) -> CodeType:
        """The changed module's code."""
        body = [self.mutated() if one is self.top else one for one in tree.body]
        return compile(ast.fix_missing_locations(ast.Module(body, [])), filename, "exec")


def mutants(module: str, tree: ast.Module) -> list[Mutant]:
    """All of a module's, in the order of its lines."""
    found: list[Mutant] = []
    names: Counter[str] = Counter()
    for top in tree.body:
        for where, path, old, new in _statement(top, (), "", is_top=True):
            change = f"{_text(old)} -> {_text(new)}"
            key = f"{where}:{change}"
            names[key] += 1
            numbered = change if names[key] == 1 else f"{change} #{names[key]}"
            found.append(Mutant(module, where, numbered, (old.lineno, old.end_lineno or old.lineno), top, path, new))
    return found


def _text(node: Any) -> str:
    if node is None:
        return "nothing"
    text = " ".join(ast.unparse(node).split())
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


# ---------------------------------------------------------------- statements

Change = tuple[str, Path, Any, Any]
"""Where, path, old node, new node (None: removed)."""


def _statement(node: ast.stmt, path: Path, where: str, *, is_top: bool = False) -> Iterator[Change]:
    match node:
        case ast.FunctionDef():
            inner = where if where and not where.endswith(".") else where + node.name
            # defaults belong to the place where the function is made
            for name in ("defaults", "kw_defaults"):
                for index, default in enumerate(getattr(node.args, name)):
                    if default is not None:
                        yield from _expression(default, (*path, ("args", None), (name, index)), where if where and inner == where else "")
            yield from _block(node, "body", path, inner)
        case ast.ClassDef():
            yield from _block(node, "body", path, f"{node.name}.")
        case ast.Import() | ast.ImportFrom() | ast.Pass() | ast.Global():
            return
        case ast.If(test=ast.Name(id="TYPE_CHECKING")) | ast.Assign(targets=[ast.Name(id="__all__")]):
            return
        case _:
            outer = "" if where.endswith(".") else where
            if not is_top and not where.endswith("."):
                yield from _removed(node, path, outer)
            yield from _fields(node, path, outer)


def _removed(node: ast.stmt, path: Path, where: str) -> Iterator[Change]:
    """Without this statement. An assignment that a later line needs fails at once, so only what must be seen is left out."""
    if isinstance(node, ast.Expr | ast.AugAssign | ast.Raise | ast.Break | ast.Continue | ast.Delete) and not _is_text(node):
        yield where, path, node, ast.copy_location(ast.Pass(), node)
    if isinstance(node, ast.Return) and node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield where, path, node, ast.copy_location(ast.Return(ast.Constant(None)), node)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _block(node: Any, field: str, path: Path, where: str) -> Iterator[Change]:
    for index, one in enumerate(getattr(node, field)):
        if not _is_text(one):
            yield from _statement(one, (*path, (field, index)), where)


def _fields(node: Any, path: Path, where: str) -> Iterator[Change]:
    """The expressions and blocks of a statement, in order."""
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "type_comment", "decorator_list", "simple"} or (field in {"target", "targets"}):
            continue
        here = (*path, (field, None))
        if field == "test" and isinstance(node, ast.If | ast.While):
            for constant in (True, False) if isinstance(node, ast.If) else (False,):
                new = ast.copy_location(ast.Constant(constant), value)
                yield where, here, value, new
        if isinstance(value, ast.expr):
            yield from _expression(value, here, where)
        elif isinstance(value, list):
            for index, one in enumerate(value):
                spot = (*path, (field, index))
                if isinstance(one, ast.stmt):
                    if not _is_text(one):
                        yield from _statement(one, spot, where)
                elif isinstance(one, ast.expr):
                    yield from _expression(one, spot, where)
                elif isinstance(one, ast.match_case):
                    yield from _arm(one, spot, where)
                elif isinstance(one, ast.ExceptHandler):
                    yield from _handler(one, spot, where)


def _arm(node: ast.match_case, path: Path, where: str) -> Iterator[Change]:
    first = node.body[0]
    if not isinstance(first, ast.Pass):
        emptied = ast.match_case(node.pattern, node.guard, [ast.copy_location(ast.Pass(), first)])
        yield where, path, _at(node, first), emptied
    if node.guard is not None:
        yield where, (*path, ("guard", None)), node.guard, ast.copy_location(ast.Constant(True), node.guard)
        yield from _expression(node.guard, (*path, ("guard", None)), where)
    yield from _block(node, "body", path, where)


def _at(node: ast.match_case, first: ast.stmt) -> Any:
    """An arm has no line of its own: that of its body."""
    arm: Any = copy.copy(node)
    arm.lineno, arm.end_lineno = first.lineno, first.lineno
    return arm


def _handler(node: ast.ExceptHandler, path: Path, where: str) -> Iterator[Change]:
    if isinstance(node.type, ast.Tuple):
        for index, caught in enumerate(node.type.elts):
            yield where, (*path, ("type", None), ("elts", index)), caught, None
    yield from _block(node, "body", path, where)


# ---------------------------------------------------------------- expressions


def _expression(node: ast.expr, path: Path, where: str) -> Iterator[Change]:
    for new in _instead(node):
        yield where, path, node, ast.copy_location(new, node)
    match node:
        case ast.Call():
            for index, keyword in enumerate(node.keywords):
                if keyword.arg is not None:
                    yield where, (*path, ("keywords", index)), _of(keyword), None
        case ast.ListComp() | ast.SetComp() | ast.GeneratorExp() | ast.DictComp():
            for number, part in enumerate(node.generators):
                for index, condition in enumerate(part.ifs):
                    spot = (*path, ("generators", number), ("ifs", index))
                    yield where, spot, condition, None
        case ast.JoinedStr():
            for index, part in enumerate(node.values):
                if isinstance(part, ast.FormattedValue):
                    yield from _expression(part.value, (*path, ("values", index), ("value", None)), where)
            return
    for field, value in ast.iter_fields(node):
        if isinstance(value, ast.expr):
            yield from _expression(value, (*path, (field, None)), where)
        elif isinstance(value, list):
            for index, one in enumerate(value):
                spot = (*path, (field, index))
                if isinstance(one, ast.expr):
                    yield from _expression(one, spot, where)
                elif isinstance(one, ast.keyword):
                    yield from _expression(one.value, (*spot, ("value", None)), where)
                elif isinstance(one, ast.comprehension):
                    yield from _expression(one.iter, (*spot, ("iter", None)), where)
                    for number, condition in enumerate(one.ifs):
                        yield from _expression(condition, (*spot, ("ifs", number)), where)


def _of(keyword: ast.keyword) -> Any:
    return keyword


def _instead(node: ast.expr) -> Iterator[ast.expr]:
    """What may stand instead of this expression, its parts left as they are."""
    match node:
        case ast.Compare():
            for index, operator in enumerate(node.ops):
                for other in ORDER[type(operator)]:
                    ops = [other() if number == index else one for number, one in enumerate(node.ops)]
                    yield ast.Compare(node.left, ops, node.comparators)
        case ast.BoolOp():
            yield ast.BoolOp(ast.And() if isinstance(node.op, ast.Or) else ast.Or(), node.values)
            for index in range(len(node.values)):
                rest = node.values[:index] + node.values[index + 1 :]
                yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.BinOp():
            if type(node.op) in ARITHMETIC:
                yield ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)
        case ast.IfExp():
            yield node.body
            yield node.orelse
        case ast.Call(func=ast.Name(id=name)) if name in OPPOSITE:
            yield ast.Call(ast.Name(OPPOSITE[name], ast.Load()), node.args, node.keywords)
        case ast.Constant():
            yield from map(ast.Constant, _other(node.value))


def _other(value: Any) -> Iterator[Any]:
    match value:
        case bool():
            yield not value
        case int():
            yield value + 1
        case float():
            yield 2.0 * value if value else 1.0
        case str() if " " not in value:
            yield f"{value}~" if value else "~"
        case bytes():
            yield value + b"~"
