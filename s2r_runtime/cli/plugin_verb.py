"""`s2r plugin list|show|check|new`: what is installed, whether it keeps its interface, and a new one to begin with."""

from __future__ import annotations

import argparse
import difflib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from s2r_runtime.cli import output, plugin_files
from s2r_runtime.errors import PluginError, UsageError, one_line

TEST_FILE = """
from s2r_runtime.testing.offered import kits
globals().update({f"TestOffer{number}": kit for number, kit in enumerate(kits(%r))})
"""
CHECK_S = 900.0
"""For a plug-in with many offers on a busy machine; the built-in ones take a tenth of a minute."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    plugin = verbs.add_parser("plugin")
    what = plugin.add_subparsers(dest="what", metavar="WHAT", required=True)
    listing = what.add_parser("list", help="every plug-in found, what it offers, and why one could not be loaded")
    listing.add_argument("--json", action="store_true", help="print one JSON object")
    listing.set_defaults(run=plugin_list)

    show = what.add_parser("show", help="what an offer is: its numbers with units and bounds, and on what it acts", description=_SHOW)
    show.add_argument("name", metavar="NAME", help="a model, an effect, a task or another offer; or a model's file (.py, .toml)")
    show.add_argument("--model", metavar="M", help="of an effect: on this model alone (a name, a Python file, or a model TOML)")
    show.add_argument("--json", action="store_true", help="print one JSON object")
    show.set_defaults(run=_shown)

    check = what.add_parser("check", help="run the kit of everything that a plug-in offers", description=_CHECK)
    check.add_argument("name", metavar="NAME", help="plug-in, as s2r plugin list names it")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    check.set_defaults(run=plugin_check)

    new = what.add_parser("new", help="write a small package to begin with", description=_NEW)
    new.add_argument("name", metavar="NAME", help="of the package and of what it offers: small letters, digits and _")
    new.add_argument("--kind", required=True, choices=plugin_files.KINDS, help="what it offers")
    new.add_argument("--to", type=Path, metavar="DIR", help="the folder to write (default: NAME here); must not be there yet")
    new.set_defaults(run=plugin_new)


_SHOW = (
    "What an offer of a plug-in is. Of an effect, its parameters with their bounds, and its channels and units on each model; of a model, "
    "its states, inputs and parameters, and the effects that make sense on it; of a task or transport, its options."
)
_CHECK = "Runs the conformance kit of everything that a plug-in offers, in a process of its own. Exit 0 if all of it passed. Needs pytest."
_NEW = "Writes a package that installs (pip install -e NAME), passes its kit (s2r plugin check NAME), and works: change it bit by bit."


def _shown(args: argparse.Namespace) -> int:
    from s2r_runtime.cli.plugin_show import plugin_show  # numpy, which no page of --help needs

    return plugin_show(args)


def plugin_list(args: argparse.Namespace) -> int:
    """Exit 0 if every plug-in found is in use, 1 if one is not."""
    from s2r_runtime.plugins import registry

    loaded = registry().loaded
    if args.json:
        output.result_json({"plugins": [p._asdict() for p in loaded]})
    else:
        for plugin in loaded:
            state = "in use" if not plugin.error else output.styled("in part" if plugin.offers else "not in use", "red")
            output.out(f"{plugin.name}  {state}")
            api = f", API {plugin.api}" if plugin.api else ""
            output.out(f"    from {plugin.distribution} {plugin.version}{api}, {plugin.origin or 'place unknown'}")
            if plugin.error:
                output.out(f"    error: {plugin.error}")
            for kind, names in plugin.offers.items():
                output.out(f"    {kind}: {', '.join(names)}")
    return 1 if any(plugin.error for plugin in loaded) else 0


class Row(NamedTuple):
    """What became of one offer's kit. `failed`: what, and why."""

    offer: str
    passed: int
    skipped: int
    failed: tuple[str, ...]


def plugin_check(args: argparse.Namespace) -> int:
    """Exit 0 if everything that the plug-in offers passed its kit, 1 if not. Raises PluginError if it is unknown or could not be loaded."""
    from s2r_runtime.plugins import registry

    found = {p.name: p for p in registry().loaded}
    if args.name not in found:
        near = difflib.get_close_matches(args.name, found, 1, 0.6)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(found)}"
        raise PluginError(f"no plug-in {args.name!r} is installed; {hint} (pip install -e FOLDER installs one of yours)")
    plugin = found[args.name]
    if plugin.error:
        raise PluginError(f"plug-in {plugin.name!r} of {plugin.distribution} is not in use: {plugin.error}")
    if not plugin.offers:
        raise PluginError(f"plug-in {plugin.name!r} of {plugin.distribution} offers nothing: {plugin.origin}")
    rows, end = _checked(plugin.name)
    ok = not end and bool(rows) and not any(row.failed for row in rows)
    if args.json:
        output.result_json({"ok": ok, "plugin": plugin.name, "offers": [row._asdict() for row in rows], "error": end})
        return 0 if ok else 1
    wide = max((len(row.offer) for row in rows), default=5)
    output.out(f"{'offer':{wide}}  passed  skipped  failed")
    for row in rows:
        failed = output.styled(f"{len(row.failed):6}", "red" if row.failed else "green")
        output.out(f"{row.offer:{wide}}  {row.passed:6}  {row.skipped:7}  {failed}")
        for text in row.failed:
            output.out(f"    {text}")
    if end:
        output.out(end)
    output.out(f"plug-in {plugin.name} {plugin.version}: " + ("keeps its interface" if ok else "does not keep its interface"))
    return 0 if ok else 1


def _checked(plugin: str) -> tuple[list[Row], str]:
    """What the kits found, and why they did not come to an end (empty if they did). Raises UsageError without pytest."""
    with tempfile.TemporaryDirectory() as folder:
        out, tests = Path(folder, "found.jsonl"), Path(folder, "test_offers.py")
        out.touch()
        tests.write_text(TEST_FILE % plugin, encoding="utf-8")
        argv = [sys.executable, "-m", "pytest", "-q", "-c", "/dev/null", "-p", "no:cacheprovider", "-p", "s2r_runtime.testing.offered"]
        argv += ["--rootdir", folder, "--basetemp", str(Path(folder, "tmp")), str(tests)]
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}
        try:
            ran = subprocess.run(
                argv,
                env={**environment, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "S2R_CHECK_OUT": str(out)},
                capture_output=True,
                text=True,
                timeout=CHECK_S,
                check=False,
                stdin=subprocess.DEVNULL,
            )
            code, said = ran.returncode, ran.stderr or ran.stdout
        except subprocess.TimeoutExpired:
            code, said = -1, f"the kits did not end within {CHECK_S:g} s"
        lines = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    if not lines and "No module named pytest" in said.replace("'", ""):
        raise UsageError("s2r plugin check needs pytest: pip install pytest")
    why = one_line(said.strip().splitlines()[-1] if said.strip() else f"exit code {code}")
    end = "" if code in (0, 1) and lines else f"the kits did not come to an end{_open(lines)}: {why}"
    return _rows(lines), end


def _open(lines: list[dict[str, Any]]) -> str:
    """The test that began and did not end."""
    ended = {(line["offer"], line["what"]) for line in lines if line["outcome"] != "began"}
    left = [f"{line['offer']}: {line['what']}" for line in lines if (line["offer"], line["what"]) not in ended]
    return f" ({left[-1]})" if left else ""


def _rows(lines: list[dict[str, Any]]) -> list[Row]:
    rows = []
    for offer in dict.fromkeys(line["offer"] for line in lines):
        of = [line for line in lines if line["offer"] == offer]
        failed = tuple(f"{line['what']}: {one_line(line['why'], 160)}" for line in of if line["outcome"] == "failed")
        passed, skipped = (sum(line["outcome"] == word for line in of) for word in ("passed", "skipped"))
        rows.append(Row(offer, passed, skipped, failed))
    return rows


def plugin_new(args: argparse.Namespace) -> int:
    """Exit 0 if the package was written."""
    folder = args.to or Path(args.name)
    written = plugin_files.write(args.name, args.kind, folder)
    for path in written:
        output.out(str(path))
    output.err(f"next: {folder}/README.md says how to install it, check it and change it")
    return 0
