"""Writes docs/commands.md from the command line itself, so that the page can't promise what `--help` doesn't know.

python tools/command_reference.py            prints it
python tools/command_reference.py --write    writes it
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from s2r_runtime.cli.main import parser

PAGE = Path(__file__).parent.parent / "docs" / "commands.md"


def text() -> str:
    """The page's text."""
    about = (
        "Written by `tools/command_reference.py` from the command line itself. Results go to stdout, everything else to stderr; `--json` "
        "prints one JSON object; `NO_COLOR` is honoured. Exit codes: 0 it holds, 1 it does not hold, 2 usage, 3 not enough evidence, 70 "
        "internal error, 78 bad configuration."
    )
    lines = ["# Commands", "", about, ""]
    for name, verb, summary in verbs(parser(), "s2r"):
        usage = " ".join(verb.format_usage().removeprefix("usage: ").split())
        lines += [f"## {name}", "", f"{summary[0].upper()}{summary[1:]}. `{usage}`", ""]
        rows = [(_form(a), (a.help or "").replace("|", "\\|")) for a in verb._actions if a.dest != "help"]
        if any(help_text for _, help_text in rows):
            lines += ["| option | meaning |", "| --- | --- |", *(f"| `{form}` | {help_text} |" for form, help_text in rows), ""]
        if verb.epilog:
            lines += [verb.epilog, ""]
    return "\n".join(lines).rstrip() + "\n"


def verbs(top: argparse.ArgumentParser, prefix: str) -> list[tuple[str, argparse.ArgumentParser, str]]:
    """(name, parser, summary) of every verb, those of two words included."""
    found: list[tuple[str, argparse.ArgumentParser, str]] = []
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            summaries = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, verb in action.choices.items():
                inner = verbs(verb, f"{prefix} {name}")
                found += inner or [(f"{prefix} {name}", verb, summaries.get(name, ""))]
    return found


def _form(action: argparse.Action) -> str:
    name = ", ".join(action.option_strings) or str(action.metavar or action.dest)
    if action.option_strings and action.nargs != 0:
        name += f" {action.metavar or '|'.join(map(str, action.choices or [])) or action.dest.upper()}"
    return name.replace("|", "\\|")


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        PAGE.write_text(text(), encoding="utf-8")
    else:
        sys.stdout.write(text())
