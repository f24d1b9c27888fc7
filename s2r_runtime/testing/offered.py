"""Runs the kit of everything that one plug-in offers: `python -m s2r_runtime.testing.offered PLUGIN OUT`, a process of its own, as what is
tried may crash or hang. OUT gets one JSON line a test, so that what was found is there however it ends.

    transports             the kits that the plug-in offers (hook `s2r_kits`): nobody else has its robot's end
    models, effects, tasks the same, or a kit on values of its own
    everything             it can be loaded
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.hookspecs import Effect
from s2r_runtime.plugins import registry
from s2r_runtime.testing.effect_kit import DT, EffectKit
from s2r_runtime.testing.model_kit import ModelKit
from s2r_runtime.testing.task_kit import TaskKit

LOADS = "it can be loaded"
NO_KIT = "no kit is offered for it, so nothing was checked: offer one by the hook s2r_kits"


class _Loads:
    """What every offer must pass."""

    kind: str
    offered: str

    def test_it_can_be_loaded(self) -> None:
        """It is there, and its parts can be imported."""
        assert registry().get(self.kind, self.offered) is not None


class _NothingChecked:
    def test_there_is_a_kit(self) -> None:
        """Nothing checked is no pass."""
        pytest.fail(NO_KIT, pytrace=False)


def kits(plugin: str) -> dict[str, type]:
    """Row of the table (`transports my_bus`) -> the class that tries it. Raises what a broken plug-in raises."""
    (loaded,) = (p for p in registry().loaded if p.name == plugin)
    found: dict[str, type] = {}
    given = loaded.offers.get("kits", ())
    for kind, names in loaded.offers.items():
        if kind == "kits":
            continue
        for name in names:
            loads = type("Loads", (_Loads,), {"kind": kind, "offered": name})
            own = [kit for kit in given if kit == f"{kind}.{name}" or kit.startswith(f"{kind}.{name}.")]
            for kit in own:
                row = " ".join([kind, name, *kit[len(f"{kind}.{name}") :].split(".")]).rstrip()
                found[re.sub(" +", " ", row)] = type("Kit", (loads, registry().get("kits", kit)), {})
            if not own:
                found[f"{kind} {name}"] = type("Kit", (loads, *_default(kind, name)), {})
    return found


def _default(kind: str, name: str) -> tuple[type, ...]:
    if kind in ("recordings", "robots"):
        return ()
    if kind == "transports":
        return (_NothingChecked,)
    thing = registry().get(kind, name)
    if kind == "models":
        return (type("Own", (ModelKit,), {"model": thing}),)
    if kind == "tasks":
        return (type("Own", (TaskKit,), {"task": thing}),)
    return (type("Own", (EffectKit,), {"effect": thing, "parameters": _values(thing)}),)


def _values(effect: Effect) -> dict[str, Any]:
    """Values at which the effect does something: from its own to begin from, else a third of the way from neutral to its bound."""
    wrong = getattr(effect, "wrong", lambda p: "")
    for values in (*_starts(effect), _third(effect, ()), _third(effect, getattr(effect, "optional", ()))):
        if values and not wrong(values):
            return values
    raise ValueError(f"{effect.name}: no values were found at which to try it; offer a kit by the hook s2r_kits")


def _starts(effect: Any) -> Iterator[dict[str, Any]]:
    if not hasattr(effect, "starts") or hasattr(effect, "takes"):
        return
    for name in registry().names("models"):
        model = registry().get("models", name)
        u = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, (20, len(model.inputs))), 5, axis=0)
        time = (DT * np.arange(len(u)),) if getattr(effect, "timed", False) else ()
        for channel in effect.channels(model):
            yield from effect.starts(u, model, channel, DT, *time)


def _third(effect: Any, without: tuple[str, ...]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for p in effect.parameters:
        if p.name in without:
            continue
        base = p.low if p.neutral is None else p.neutral
        number = base + (p.high - base) / 3.0
        words = getattr(effect, "choices", {}).get(p.name)
        if words:
            values[p.name] = words[0]
        elif p.name in getattr(effect, "named", ()):
            values[p.name] = ""  # the kit fills in an input of the model
        else:
            values[p.name] = [[number] * p.shape[1] for _ in range(p.shape[0])] if p.shape else number
    return values


class _Reports:
    """Writes a line as soon as a test is over."""

    def __init__(self, rows: list[str], out: Path) -> None:
        self._rows, self._out = rows, out.open("w", encoding="utf-8")

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """It begins: if nothing follows, this is where it hung or crashed."""
        self._say(nodeid, "began", "")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """It is over."""
        if report.when == "call" or report.outcome != "passed":
            text = str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else _why(report.longreprtext)
            self._say(report.nodeid, report.outcome, text)

    def _say(self, nodeid: str, outcome: str, text: str) -> None:
        found = re.search(r"::TestOffer(\d+)::test_(.*)$", nodeid)
        if found is not None:
            what = found.group(2).replace("_", " ")
            print(
                json.dumps({"offer": self._rows[int(found.group(1))], "what": what, "outcome": outcome, "why": text}),
                file=self._out,
                flush=True,
            )


def _why(text: str) -> str:
    """The line of a report that says what was wrong."""
    lines = [line[1:].strip() for line in text.splitlines() if line.startswith("E ")]
    return (lines or text.strip().splitlines()[-1:] or [""])[0]


TEST_FILE = """
import sys
from s2r_runtime.testing.offered import kits
globals().update({f"TestOffer{number}": kit for number, kit in enumerate(kits(%r).values())})
"""


def main(plugin: str, out: str) -> int:
    """Exit 0 if all passed."""
    rows = list(kits(plugin))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "test_offers.py")
        file.write_text(TEST_FILE % plugin, encoding="utf-8")
        quiet = ["-q", "-c", "/dev/null", "-p", "no:cacheprovider", "--rootdir", folder, "--basetemp", str(Path(folder, "tmp"))]
        return int(pytest.main([*quiet, str(file)], plugins=[_Reports(rows, Path(out))]))


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:3]))
