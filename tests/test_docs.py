"""What the docs show is what happens: console blocks are run, Python blocks are run, verbs and hooks are all documented.

A ```console block's lines that begin with `$ ` are commands, the lines after each are its stdout and stderr; `...` stands
for anything. Python blocks of a page share their names. Blocks marked no-run show what needs hardware, root or minutes. Those
marked `needs MODULE` are run where that extra is installed.
The demo is run by test_demo.py, a log and a daemon in Python by test_python_evidence.py.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import profile_reference
import pytest
from command_reference import text, verbs

from s2r_runtime import hookspecs
from s2r_runtime.cli.main import parser

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list[tuple[str, str]]:
    """(page and line, text) of every fenced block in that language that is to be run."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in FENCE.finditer(text):
            extra = match.group(2).partition("needs ")[2].strip()
            if match.group(1) == language and "no-run" not in match.group(2) and (not extra or importlib.util.find_spec(extra)):
                line = text.count("\n", 0, match.start()) + 1
                found.append((f"{page.relative_to(ROOT)}:{line}", match.group(3)))
    return found


def commands(block: str) -> list[tuple[str, str]]:
    """(command, expected output) pairs of a console block."""
    pairs: list[tuple[str, str]] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            pairs.append((line[2:], ""))
        elif pairs:
            command, expected = pairs[-1]
            pairs[-1] = (command, expected + line + "\n")
    return pairs


def matches(expected: str, got: str) -> bool:
    pattern = ".*?".join(re.escape(piece) for piece in re.split(r"\.\.\.", expected.strip()))
    return re.fullmatch(pattern, got.strip(), re.DOTALL) is not None


@pytest.mark.slow
@pytest.mark.parametrize(("where", "block"), blocks("console"), ids=[w for w, _ in blocks("console")])
def test_console_block_shows_what_happens(where: str, block: str, tmp_path: Path) -> None:
    for folder in ("profiles", "controllers", "examples"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "NO_COLOR": "1",
        "XDG_CONFIG_HOME": str(tmp_path / "config"),
    }
    environment.pop("XDG_RUNTIME_DIR", None)
    for command, expected in commands(block):
        done = subprocess.run(
            ["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=100, check=False
        )
        assert matches(expected, done.stdout + done.stderr), f"{where}: {command}\nshown:\n{expected}\ngot:\n{done.stdout}{done.stderr}"


def python_pages() -> dict[str, list[tuple[str, str]]]:
    """Page -> its Python blocks: (page and line, text)."""
    found: dict[str, list[tuple[str, str]]] = {}
    for where, block in blocks("python"):
        found.setdefault(where.partition(":")[0], []).append((where, block))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("page", python_pages())
def test_python_blocks_of_a_page_run_one_after_the_other_in_an_empty_folder(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {"__name__": "docs"}
    for where, block in python_pages()[page]:
        exec(compile(block, where, "exec"), names)  # noqa: S102 - the docs' own code


def test_command_reference_is_the_command_line() -> None:
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8") == text()


def test_profile_reference_is_what_a_profile_may_say() -> None:
    assert (ROOT / "docs" / "profile.md").read_text(encoding="utf-8") == profile_reference.text()


def test_the_tracing_page_names_files_and_functions_that_exist() -> None:
    page = (ROOT / "docs" / "tracing.md").read_text(encoding="utf-8")
    named = re.findall(r"`(?:s2r_runtime/trace/)?((?:\w+/)?\w+\.py)`(?: \((`\w+`(?:, `\w+`)*)\))?", page)
    named += [(file, name) for name, file in re.findall(r"(`\w+`) (?:of|in) `((?:\w+/)?\w+\.py)`", page)]
    assert len(named) > 15
    missing = []
    for file, functions in named:
        found = [path for path in (ROOT / "s2r_runtime").rglob(file.rpartition("/")[2]) if path.as_posix().endswith(f"/{file}")]
        code = "".join(path.read_text(encoding="utf-8") for path in found)
        names = re.findall(r"`(\w+)`", functions)
        missing += (
            [file] if not found else [f"{file}: {n}" for n in names if not re.search(rf"^(?:def {n}\(|{n}\b.* = )", code, re.MULTILINE)]
        )
    assert missing == []


def test_every_verb_that_prints_json_says_what() -> None:
    page = (ROOT / "docs" / "json.md").read_text(encoding="utf-8")
    told = {name for row in re.findall(r"^\| (`[^|]*`) \|", page, re.MULTILINE) for name in re.findall(r"`([^`]+)`", row)}
    asked = [name.removeprefix("s2r ") for name, verb, _ in verbs(parser(), "s2r") if any(one.dest == "json" for one in verb._actions)]
    assert asked
    assert [name for name in asked if name not in told] == []


def test_every_hook_is_documented() -> None:
    page = (ROOT / "docs" / "plugin-reference.md").read_text(encoding="utf-8")
    hooks = [name for name in vars(hookspecs) if name.startswith("s2r_")]
    assert hooks
    assert [name for name in hooks if f"`{name}`" not in page] == []


def test_links_lead_somewhere() -> None:
    links = [(page, target) for page in PAGES for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))]
    broken = [f"{page.relative_to(ROOT)} -> {target}" for page, target in links if not (page.parent / target).exists()]
    assert broken == []


def _anchors(page: Path) -> set[str]:
    """The anchors that a Markdown page has on its host: headings in lower case, words joined by hyphens, without punctuation."""
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", prose, re.MULTILINE)}


def test_links_into_a_page_lead_to_a_heading() -> None:
    links = [
        (page, page.parent / target if target else page, anchor)
        for page in (*PAGES, ROOT / "CHANGELOG.md")
        for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text(encoding="utf-8"))
    ]
    assert links
    broken = [f"{page.relative_to(ROOT)} -> {target.name}#{anchor}" for page, target, anchor in links if anchor not in _anchors(target)]
    assert broken == []


def test_the_map_of_files_names_every_module() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    root = ROOT / "s2r_runtime"
    modules = [p.stem for p in root.glob("*.py") if p.stem != "__init__"] + [p.parent.name for p in root.glob("*/__init__.py")]
    assert [name for name in modules if f"`{name}`" not in readme] == []


def test_the_threat_model_names_tests_that_exist() -> None:
    page = (ROOT / "docs" / "threat-model.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:plugins/\w+/tests/)?test_\w+\.py)(?:::(test_\w+))?`", page)
    assert len(named) > 15
    for file, function in named:
        path = ROOT / file if file.startswith("plugins") else ROOT / "tests" / file
        assert path.is_file(), file
        assert not function or f"def {function}(" in path.read_text(encoding="utf-8"), f"{file}::{function}"
