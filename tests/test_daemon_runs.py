"""The real daemon counts the runs of a real controller: in log and status, over SIGKILL; the audit computes them again (G10)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime import messages as m

TASK = """name = "stl"
[task.parameters]
horizon = 0.5
metric = "always (x < 5)"
progress = "none"
start = { theta = { normal = [0.0, 0.1] } }
"""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    """A robot and a controller that turns on the spot, in scenarios of half a second."""
    one = Rig(tmp_path)
    text = one.profile.read_text().replace('name = "grid_world"\n', TASK)
    one.profile.write_text(text)
    one.start_robot()
    try:
        yield one
    finally:
        one.close()


def counted(rig: Rig) -> list[m.EpisodeCounted]:
    return [message for message in rig.messages("out/episode_counted") if isinstance(message, m.EpisodeCounted)]


def kept_runs(rig: Rig) -> int:
    """Runs of the controller that drives, in the state folder."""
    path = rig.state / "state.json"
    runs = json.loads(path.read_text())["content"].get("runs", []) if path.exists() else []
    return max((one["n"] for one in runs), default=0)


def runs_of(rig: Rig) -> Any:
    return rig.status()["runs"]


@pytest.mark.slow
def test_runs_are_counted_over_a_kill_and_an_old_state_does_not_forget_them(rig: Rig) -> None:
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until(lambda: len(counted(rig)) >= 4 and kept_runs(rig) >= 4)  # status shows them some milliseconds before they are on the disk
    rig.kill()
    kept = (rig.state / "state.json").read_bytes()
    rig.start()
    after = runs_of(rig)["all"]
    assert (after["n"] >= 5, after["censored"], after["unsafe"]) == (True, 1, 0), "the run that the kill cut"
    assert after["statement"].startswith("of the runs this controller drives on this robot, at most ")
    assert rig.s2r("status").stdout.count("runs        of the runs this controller drives") == 1
    assert rig.stop() == 0
    (rig.state / "state.json").write_bytes(kept)  # the memory of before the kill was counted
    rig.start()
    assert "going on from what" in rig.said()
    again = runs_of(rig)["all"]
    assert (again["n"], again["censored"]) == (after["n"], 1)
    assert rig.stop() == 0
    audited = rig.s2r("audit", *map(str, rig.log_files()), "--json")
    result = json.loads(audited.stdout)
    assert result["first_difference"] is None, result
    assert result["recomputed"]["runs"] >= 4
    safe = [one for one in counted(rig) if one.outcome == "safe"]
    assert [one.limits[0].n for one in safe] == list(range(1, len(safe) + 1))


@pytest.mark.slow
def test_a_controller_that_is_unsafe_too_often_is_revoked_and_stays_refused(rig: Rig) -> None:
    text = rig.profile.read_text().replace("always (x < 5)", "always (x > 5)")
    rig.profile.write_text(text.replace("[guarantee]\n", "[guarantee]\nmax_unsafe = 0.2\n"))
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until(lambda: runs_of(rig)["refused"])
    rig.until_status(controller=None)
    refused = rig.ask("deploy", path=str(rig.folder / "controller.py"))
    assert refused["exit_code"] == 1
    assert "unsafe_runs" in refused["text"]
    assert "REFUSED" in rig.s2r("status").stdout
    assert rig.stop() == 0
    last = [one for one in counted(rig) if one.limits][-1]
    assert last.limits[0].lower > 0.2
    assert all(one.outcome in ("unsafe", "left_out") for one in counted(rig) if one.index > 0)
    audited = rig.s2r("audit", *map(str, rig.log_files()), "--json")
    assert json.loads(audited.stdout)["first_difference"] is None, audited.stdout


@pytest.mark.slow
def test_learned_policy_is_verified_certified_and_drives(rig: Rig) -> None:
    """From a campaign to counted runs, then the audit evaluates the policy again on every state; a file that does not fit costs nothing."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from onnx_rig import linear, tables, write

    weights = [[0.0, 0.02], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.01]]
    settings = tables(("x", "time_left"), top="history = 2", limits="lower = -0.1\nupper = 0.1")
    good = write(rig.folder, linear([*weights[:3], [0.0, 0.3]]), settings)
    bad = write(rig.folder, linear(weights), settings, "bad")
    rig.start()
    assert rig.sample()["exit_code"] == 0
    refused = rig.ask("deploy", path=str(bad))
    assert refused["exit_code"] == 78
    assert "bad.onnx: its input has shape (n, 5), must be (n, 2, 2) or (n, 4)" in refused["text"]
    assert rig.status()["attempts"] == 0
    answer = rig.ask("deploy", path=str(good))
    assert answer["exit_code"] == 0, answer
    rig.until(lambda: (runs_of(rig)["all"] or {"n": 0})["n"] >= 4)
    assert rig.stop() == 0
    audited = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--rerun-controllers", "--json").stdout)
    assert (audited["ok"], audited["first_difference"], audited["unchecked"]) == (True, None, []), audited
    assert audited["recomputed"]["driving commands that their controller gives again"] > 50
