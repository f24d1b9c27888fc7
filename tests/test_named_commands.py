"""Every verb and every option that a hint, a reason, an error or a page names is one that the command line has."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from s2r_runtime.cli.main import parser

ROOT = Path(__file__).parent.parent
COMMAND = re.compile(r"\bs2r ([a-z]+)\b((?: +[^\s;,()`'\"]+)*)")
"""`s2r VERB ...` up to the end of the clause."""
OPTION = re.compile(r"(?<!\S)--[a-z][a-z-]*")
NOT_VERBS = {"log", "is", "and", "in", "can", "for", "itself", "has", "plugin", "runtime", "on", "with", "from", "by", "as", "certificate"}
"""Words that follow the program's name in a sentence. (Groups of verbs among them are looked into below.)"""


def sub_verbs(of: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    groups = [action for action in of._actions if isinstance(action, argparse._SubParsersAction)]
    return dict(groups[0].choices) if groups else {}


VERBS = sub_verbs(parser())


def texts() -> Iterator[tuple[str, str]]:
    """(where, text): what the program says, and what its pages say."""
    for path in sorted((ROOT / "s2r_runtime").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            yield f"{path.name}:{number}", line


def named(text: str) -> Iterator[tuple[str, str]]:
    """(verb, what follows) for each command that a text names."""
    for match in COMMAND.finditer(text):
        yield match[1], match[2]


def wrong(text: str) -> list[str]:
    found = []
    for verb, rest in named(text):
        if verb not in VERBS:
            found += [] if verb in NOT_VERBS else [f"s2r {verb}: no such verb"]
            continue
        chosen = VERBS[verb]
        words = rest.split()
        if words and words[0] in (deeper := sub_verbs(chosen)):
            chosen = deeper[words[0]]
        has = {option for action in chosen._actions for option in action.option_strings}
        found += [f"s2r {verb}{rest}: no option {option}" for option in OPTION.findall(rest) if option not in has]
    return found


@pytest.mark.slow
def test_what_is_named_is_there() -> None:
    assert [f"{where}: {one}" for where, text in texts() for one in wrong(text)] == []


@pytest.mark.parametrize("text", ["first: s2r deploy --undeploy", "try s2r dance", "`s2r log info LOG --colour`"])
def test_what_is_not_there_is_noticed(text: str) -> None:
    assert wrong(text)
