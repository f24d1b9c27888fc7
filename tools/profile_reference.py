"""Writes docs/profile.md from the profile's own structs, so that the page can't promise what no profile has.

python tools/profile_reference.py            prints it
python tools/profile_reference.py --write    writes it
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.profile import Profile

PAGE = Path(__file__).parent.parent / "docs" / "profile.md"
TASKS = ("grid_world", "keep_out")
"""Built-in tasks whose parameters are numbers; those of `stl` have a page of their own."""
HEAD = """# The profile: every setting

Written by `tools/profile_reference.py` from the program itself. One robot is one TOML file; [for the robot owner](robot-owner.md) says how
to begin one, and `s2r profile check PROFILE --defaults` prints all that is in force. Times are in s, lengths in m, angles in rad. What has
no default must be set. Effects of a model are on [a page of their own](effects.md), and so are
tasks that are [written as text](tasks.md) and the options of transports:
[Zenoh](zenoh.md), [MAVLink](mavlink.md), [CAN](can.md), [ROS 2](ros2.md).
"""


def text() -> str:
    """The page's text."""
    own, tables = [], []
    for field in msgspec.structs.fields(Profile):
        (tables if _is_table(field.type) else own).append(field)
    parts = [HEAD, "## At the top\n", _table(_rows(Profile, {field.name for field in own}))]
    for field in tables:
        parts += [f"## `[{field.name}]`\n", f"{inspect.getdoc(field.type)}\n", _table(_rows(field.type))]
        if field.type is ModelSpec:
            parts += ["### `[[model.effects]]`\n", _table(_rows(EffectSpec))]
    for name in TASKS:
        explained: dict[str, tuple[Any, str]] = registry().get("tasks", name).PARAMETERS
        rows = ((parameter, f"`{default:g}`", meaning) for parameter, (default, meaning) in explained.items())
        parts += [f"## `[task.parameters]` of `{name}`\n", _table(rows)]
    parts.append("Those of `stl`, and what a formula may be: [tasks](tasks.md).")
    return "\n".join(parts) + "\n"


def _is_table(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _table(rows: Iterator[tuple[str, str, str]]) -> str:
    lines = ["| setting | default | meaning |", "| --- | --- | --- |"]
    return (
        "\n".join([*lines, *(f"| `{name}` | {default} | {meaning.replace('|', chr(92) + '|')} |" for name, default, meaning in rows)])
        + "\n"
    )


def _rows(kind: type[msgspec.Struct], only: set[str] | None = None) -> Iterator[tuple[str, str, str]]:
    """(name, default, meaning) of its fields. Raises KeyError for one that nothing is said about."""
    meanings = _meanings(kind)
    for field in msgspec.structs.fields(kind):
        if only is None or field.name in only:
            yield field.name, _default(field), meanings[field.name]


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return ""
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()  # type: ignore[operator]
    if isinstance(value, tuple):
        value = list(value)
    return f"`{json.dumps(value)}`" if value or isinstance(value, bool | int | float) else "empty"


def _meanings(kind: type[msgspec.Struct]) -> dict[str, str]:
    """Field -> the text that stands below it in the struct's source."""
    (struct,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(struct, ast.ClassDef)
    return {
        str(ast.unparse(field.target)): " ".join(said.value.value.split())
        for field, said in zip(struct.body, struct.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign) and isinstance(said, ast.Expr) and isinstance(said.value, ast.Constant)
    }


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        PAGE.write_text(text(), encoding="utf-8")
    else:
        sys.stdout.write(text())
