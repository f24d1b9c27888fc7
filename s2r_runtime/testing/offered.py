"""Tries everything that one plug-in offers: a pytest plug-in, for the process that `s2r plugin check` starts, as it may crash or hang.

S2R_CHECK_OUT names a file that gets one JSON line a test, so that what was found is there however it ends.

    transports             the kits that the plug-in offers (hook `s2r_kits`): nobody else has its robot's end
    models, effects, tasks the same, or a kit on values of its own
    everything             it can be loaded
"""

from __future__ import annotations

import json
import os
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


class _Cannot:
    why: str

    def test_its_kit_can_be_made(self) -> None:
        """Nothing checked is no pass."""
        pytest.fail(self.why, pytrace=False)


def kits(plugin: str) -> list[type]:
    """The classes that try what it offers, each with its `row` of the table (`transports my_bus`). Raises what a broken plug-in raises."""
    (loaded,) = (p for p in registry().loaded if p.name == plugin)
    found: list[type] = []
    given = loaded.offers.get("kits", ())
    for kind, names in loaded.offers.items():
        if kind == "kits":
            continue
        for name in names:
            loads = type("Loads", (_Loads,), {"kind": kind, "offered": name})
            own = [kit for kit in given if kit == f"{kind}.{name}" or kit.startswith(f"{kind}.{name}.")]
            rows = [" ".join([kind, name, *filter(None, kit[len(f"{kind}.{name}") :].split("."))]) for kit in own] or [f"{kind} {name}"]
            for row, kit in zip(rows, own or [""], strict=True):
                try:
                    bases = (registry().get("kits", kit),) if kit else _default(kind, name)
                    found.append(type("Kit", (loads, *bases), {"row": row}))
                except Exception as error:  # noqa: BLE001 - what an author's modules raise is what there is to say
                    found.append(type("Kit", (loads, _Cannot), {"row": row, "why": f"{type(error).__name__}: {error}"}))
    return found


def _default(kind: str, name: str) -> tuple[type, ...]:
    if kind in ("recordings", "formats", "robots"):
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


def pytest_configure(config: pytest.Config) -> None:
    """Registers the reports, if somebody wants them."""
    if out := os.environ.get("S2R_CHECK_OUT"):
        config.pluginmanager.register(_Reports(Path(out)))


class _Reports:
    """Writes a line as soon as a test begins, and one when it is over."""

    def __init__(self, out: Path) -> None:
        self._out = out.open("w", encoding="utf-8")
        self._rows: dict[str, str] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """The row of the table to which each belongs."""
        self._rows = {item.nodeid: item.parent.obj.row for item in items if item.parent is not None}  # type: ignore[attr-defined]

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """It begins: if nothing follows, this is where it hung or crashed."""
        self._say(nodeid, "began", "")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """It is over."""
        if report.when == "call" or report.outcome != "passed":
            text = str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else _why(report.longreprtext)
            self._say(report.nodeid, report.outcome, text)

    def _say(self, nodeid: str, outcome: str, text: str) -> None:
        what = nodeid.rpartition("::test_")[2].replace("_", " ")
        print(json.dumps({"offer": self._rows[nodeid], "what": what, "outcome": outcome, "why": text}), file=self._out, flush=True)


def _why(text: str) -> str:
    """What a report says was wrong, in its first lines."""
    lines = [line[1:].strip() for line in text.splitlines() if line.startswith("E ")]
    return " ".join(lines[:3]) or (text.strip().splitlines() or [""])[-1]
