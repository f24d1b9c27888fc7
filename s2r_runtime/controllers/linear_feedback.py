"""Linear feedback that shows in a controller's source: then its closed loop has an exact tube (guarantee G13). Nothing is executed.

    import numpy as np
    GAIN = [[2.0, 0.0, 2.0, 0.0], [0.0, 2.0, 0.0, 2.0]]      a literal: K, an input a row, a state a column

    def reference(theta, parameters):                        sees the scenario, never the state
        ...
        return target, feedforward                           r (n, nx), v (n, nu)

    def control(x, theta, parameters):
        target, feedforward = reference(theta, parameters)
        return feedforward - (x - target) @ np.array(GAIN).T

`control` must have exactly this body (a docstring may precede it), GAIN, `reference`, `control` and `np` may be bound once. So
u = v - K (x - r) with v and r that do not depend on x, whatever `reference` computes. That it reaches for x by other means (frames of the
interpreter, memory from call to call) is excluded as for every controller: it is taken to be a function of its arguments.
"""

from __future__ import annotations

import ast

from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.controllers.policy import is_policy

BODY = "target, feedforward = reference(theta, parameters)\nreturn feedforward - (x - target) @ np.array(GAIN).T"
NAMES = ("GAIN", "reference", "control", "np", "numpy")


def gain_of(file: ControllerFile) -> tuple[tuple[float, ...], ...] | None:
    """K, (nu, nx), if the source is of this form; None if it is not."""
    if is_policy(file.entry):
        return None
    try:
        tree = ast.parse(file.source)
    except (SyntaxError, ValueError):
        return None
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef) and not node.decorator_list}
    control, reference = functions.get("control"), functions.get("reference")
    if control is None or reference is None or not _is_form(control) or _arguments(reference) != ["theta", "parameters"]:
        return None
    if any(_times_bound(tree, name) != 1 for name in NAMES[:4]) or _times_bound(tree, "numpy") or not _imports_numpy(tree):
        return None
    return next((_literal(node.value) for node in tree.body if isinstance(node, ast.Assign) and _targets(node) == ["GAIN"]), None)


def _is_form(control: ast.FunctionDef) -> bool:
    body = control.body[1:] if ast.get_docstring(control) is not None else control.body
    return _arguments(control) == ["x", "theta", "parameters"] and "\n".join(ast.unparse(one) for one in body) == BODY


def _arguments(function: ast.FunctionDef) -> list[str]:
    a = function.args
    plain = not (a.posonlyargs or a.kwonlyargs or a.vararg or a.kwarg or a.defaults)
    return [one.arg for one in a.args] if plain else []


def _times_bound(tree: ast.Module, name: str) -> int:
    """How often anything in the module binds the name: assignments, definitions, imports, arguments, `global` statements."""
    count = 0
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=found, ctx=ast.Store() | ast.Del()) if found == name:
                count += 1
            case ast.FunctionDef(name=found) | ast.AsyncFunctionDef(name=found) | ast.ClassDef(name=found) if found == name:
                count += 1
            case ast.arg(arg=found) if found == name:
                count += 1
            case ast.alias(name=imported, asname=asname) if name == (asname or imported).split(".")[0] or imported == "*":
                count += 1
            case ast.Global(names=names) | ast.Nonlocal(names=names) if name in names:
                count += 1
            case ast.MatchAs(name=found) | ast.MatchStar(name=found) | ast.ExceptHandler(name=found) if found == name:
                count += 1
    return count


def _imports_numpy(tree: ast.Module) -> bool:
    return any(isinstance(node, ast.Import) and any((a.name, a.asname) == ("numpy", "np") for a in node.names) for node in tree.body)


def _targets(node: ast.Assign) -> list[str]:
    return [target.id for target in node.targets if isinstance(target, ast.Name)]


def _literal(value: ast.expr) -> tuple[tuple[float, ...], ...] | None:
    try:
        rows = ast.literal_eval(value)
        found = tuple(tuple(float(one) for one in row) for row in rows)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None
    return found if found and found[0] and len({len(row) for row in found}) == 1 else None
