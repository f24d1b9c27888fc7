"""Two certified controllers drive common scenarios through a real daemon over Zenoh; the log gives the same numbers again (G14)."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import PROGRAM
from zenoh_rig import ZenohRig

from s2r_runtime import messages as m

pytest.importorskip("s2r_zenoh")
pytest.importorskip("s2r_standins")

TASK = """name = "stl"
[task.parameters]
horizon = HORIZON
metric = "always (hypot(x - x0, y - y0) < room)"
progress = "none"
start = { theta = [-3.2, 3.2] }
[task.parameters.scenario]
x0 = "x"
y0 = "y"
room = { choice = [0.03, 0.03, 0.03, 1.0] }
"""
CIRCLE = "    return np.tile([0.2, 2.5], (len(x), 1))\n"
"""It moves some 9 cm in a run, so it is unsafe in three of four."""
PARTS = ("answer", "decided_at", "n", "agree", "a", "b", "difference", "lower", "upper", "e_worse", "e_not_worse", "e_better", "censored")


LONG_S = 20.0
"""A run that takes seconds, so that it can be cut."""
NEVER = ("--delta", "0.9")
"""Decides nothing in a few pairs."""


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[ZenohRig]:
    """The daemon with two certified controllers: one stays where it is, the other one drives in a circle. param: the task's horizon, s."""
    one = ZenohRig(tmp_path)
    task = TASK.replace("HORIZON", str(getattr(request, "param", 0.5)))
    one.profile.write_text(one.profile.read_text().replace('name = "grid_world"\n', task))
    one.start()
    one.start_robot()
    for path in controllers(one):
        assert one.deploy(path)["exit_code"] == 0
        one.until_status(gate="open")
        assert one.ask("undeploy")["exit_code"] == 0
    try:
        yield one
    finally:
        one.close()


def controllers(rig: ZenohRig) -> tuple[Path, Path]:
    return rig.controller("    return np.tile([0.0, 0.5], (len(x), 1))\n", "still.py"), rig.controller(CIRCLE, "circle.py")


def compare(rig: ZenohRig, *options: str, logs: Sequence[str] = ()) -> tuple[int, dict[str, Any], str]:
    """Exit code, result and lines of `s2r compare --json`."""
    done = rig.s2r("compare", *map(str, controllers(rig)), *logs, "--profile", str(rig.profile), "--json", *options)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout), done.stderr


def live(rig: ZenohRig, *options: str, most: int = 200, logs: Sequence[str] = ()) -> tuple[int, dict[str, Any], str]:
    return compare(rig, "--live", str(most), *options, logs=logs)


def begun(rig: ZenohRig, *options: str) -> subprocess.Popen[str]:
    """A live comparison in progress."""
    argv = [sys.executable, str(PROGRAM), "s2r", "compare", *map(str, controllers(rig)), "--profile", str(rig.profile), "--json"]
    argv += ["--live", *options]
    return subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=rig.environment, cwd=rig.folder)


def recomputed(rig: ZenohRig, live: dict[str, Any], *options: str) -> dict[str, Any]:
    """The same comparison from all logs that are there, which must give the same numbers."""
    _, found, _ = compare(rig, "--seed", str(live["seed"]), *options, logs=[str(path) for path in rig.log_files()])
    assert [found[name] for name in PARTS] == [live[name] for name in PARTS]
    assert found["unpaired"] == live["unpaired"]
    return found


def driven(rig: ZenohRig, seed: int) -> list[tuple[str, int]]:
    """Which controller drove which scenario of the comparison, in order."""
    found = [one for one in rig.messages("out/start_controller") if isinstance(one, m.StartController)]
    still = found[0].digest
    mine = [(one.digest, one.scenarios) for one in found if one.scenarios is not None and one.scenarios.seed == seed]
    return [("still" if digest == still else "circle", scenarios.first) for digest, scenarios in mine if scenarios is not None]


@pytest.mark.slow
def test_live_comparison_stops_by_itself_and_the_log_gives_the_same_numbers(rig: ZenohRig) -> None:
    code, found, lines = live(rig, "--beta", "0.5")
    assert (code, found["answer"], found["stopped"]) == (1, "worse", ""), (found, lines)
    assert 2 <= found["n"] == found["decided_at"] <= 20
    assert (found["a"], found["censored"], found["unpaired"]) == (1.0, 0, [0, 0])
    shown = [line for line in lines.splitlines() if line.startswith("pair ")]
    assert len(shown) == 2 * found["n"], "one line after every run"
    assert "not worse" in shown[1]
    assert rig.status()["controller"] is None
    assert rig.stop() == 0
    order = driven(rig, found["seed"])
    assert order[:4] == [("still", 0), ("circle", 0), ("circle", 1), ("still", 1)]
    assert recomputed(rig, found, "--beta", "0.5")["statement"] == found["statement"]
    audited = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--rerun-controllers", "--json").stdout)
    assert (audited["ok"], audited["first_difference"]) == (True, None), audited
    assert audited["recomputed"]["runs"] >= 2 * found["n"]


def driving(rig: ZenohRig, number: int) -> None:
    """Waits until the comparison's deployment of this number drives; the numbers 0, 3 and 4 are of the one that stays where it is."""
    rig.until(lambda: len([one for one in rig.messages("out/start_controller") if getattr(one, "scenarios", None)]) > number)
    rig.until_status(gate="open", driving="controller")


@pytest.mark.slow
@pytest.mark.parametrize("rig", [LONG_S], indirect=True)
def test_run_cut_by_a_kill_is_censored_and_the_comparison_goes_on_with_the_next_daemon(rig: ZenohRig) -> None:
    process = begun(rig, *NEVER)
    driving(rig, 4)
    rig.kill()
    text, lines = process.communicate(timeout=60)
    first = json.loads(text)
    assert process.returncode == 3, lines
    assert "the daemon does not answer" in first["stopped"]
    assert (first["n"], first["censored"]) == (3, 1), "the cut run is a pair, though nobody drove with it"
    recomputed(rig, first, *NEVER)
    logs = [str(path) for path in rig.log_files()]
    rig.start()
    rig.until_status(link=True)
    code, found, lines = live(rig, "--seed", str(first["seed"]), *NEVER, most=4, logs=logs)
    assert (code, found["n"], found["censored"], found["unpaired"]) == (3, 4, 1, [0, 0]), (found, lines)
    assert rig.stop() == 0
    recomputed(rig, found, *NEVER)


@pytest.mark.slow
@pytest.mark.parametrize("rig", [LONG_S], indirect=True)
def test_robot_that_freezes_ends_the_comparison_with_the_gate_closed_as_any_deployment(rig: ZenohRig) -> None:
    process = begun(rig, *NEVER)
    driving(rig, 3)
    assert rig.robot is not None
    rig.robot.send_signal(signal.SIGSTOP)
    text, lines = process.communicate(timeout=90)
    rig.robot.send_signal(signal.SIGCONT)
    found = json.loads(text)
    assert "the gate has been closed for 40 s" in found["stopped"], lines
    assert (found["n"], found["a"]) == (2, 0.5), "the run in which the link was lost counts as unsafe, as the profile says"
    assert rig.status()["controller"] is None
    assert rig.stop() == 0
    recomputed(rig, found, *NEVER)


@pytest.mark.slow
@pytest.mark.parametrize("rig", [LONG_S], indirect=True)
def test_interrupted_comparison_undeploys_and_counts_the_cut_run_as_the_daemon_does(rig: ZenohRig) -> None:
    process = begun(rig, *NEVER)
    driving(rig, 0)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    found = json.loads(text)
    assert found["stopped"] == "this program was interrupted"
    assert rig.status()["controller"] is None
    assert (found["n"], found["censored"]) == (1, 1)
    assert rig.stop() == 0
    recomputed(rig, found, *NEVER)


def test_controller_without_a_certificate_spends_no_attempt(rig: ZenohRig) -> None:
    still, _ = controllers(rig)
    attempts = rig.status()["attempts"]
    other = rig.controller("    return np.tile([0.0, 0.1], (len(x), 1))\n", "other.py")
    options = ("--live", "--profile", str(rig.profile))
    done = rig.s2r("compare", str(other), str(still), *options)
    assert (done.returncode, "no certificate covers this controller" in done.stderr) == (3, True), done.stderr
    assert rig.status()["attempts"] == attempts
    assert rig.s2r("compare", str(still), str(still), *options).returncode == 2
