"""A whole campaign of the walking robot over real Zenoh, in rigid-body physics: short ways and a loose epsilon, otherwise as it ships."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from s2r_runtime import messages as m
from s2r_runtime.plugins import registry
from s2r_runtime.recording.writer import read_all

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="the robot's physics are an extra: s2r-standins[sim]"),
    pytest.mark.timeout(480),
]

CHANGED = {
    "epsilon = 0.03\nbeta = 0.05": "epsilon = 0.5\nbeta = 0.5",  # four samples
    "waypoint_margin = 0.6": "waypoint_margin = 2.2",
}


def s2r(*argv: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "s2r_runtime.cli.main", *map(str, argv)]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder / "run"), "XDG_STATE_HOME": str(folder / "state")}
    return subprocess.run(command, capture_output=True, text=True, timeout=420, check=False, env=environment)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, object]]:
    """(folder, profile, what `s2r sample` answered)."""
    folder = tmp_path_factory.mktemp("walk")
    (folder / "run").mkdir(mode=0o700)
    with ExitStack() as stack:
        ports = [stack.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(2)]
    ends = [f"tcp/127.0.0.1:{port}" for port in ports]
    text = (Path(__file__).parent.parent / "profiles" / "quadruped.toml").read_text(encoding="utf-8")
    for old, new in {**CHANGED, "tcp/127.0.0.1:7461": ends[0], "tcp/127.0.0.1:7462": ends[1]}.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    profile = folder / "quadruped.toml"
    profile.write_text(text, encoding="utf-8")
    argv = [sys.executable, "-m", "s2r_standins.quadruped", "--seed", "3", "--connect", ends[0], "--parent", str(os.getpid())]
    with (folder / "robot.txt").open("w") as sink:
        robot = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink)
        try:
            done = s2r("sample", profile, "-o", folder / "walk.mcap", "--json", folder=folder)
        finally:
            robot.terminate()
            robot.wait(30)
    assert done.returncode == 0, done.stdout + done.stderr + (folder / "robot.txt").read_text()
    return folder, profile, json.loads(done.stdout)


def test_it_walks_stops_holds_and_founds_a_gap(campaign: tuple[Path, Path, dict[str, object]]) -> None:
    folder, _, answer = campaign
    gap = answer["gap"]
    assert isinstance(gap, dict)
    samples = [e.message for e in read_all([folder / "walk.mcap"]).entries() if isinstance(e.message, m.SampleTaken)]
    assert len(samples) == answer["n"] == gap["n"]
    assert all(abs(s.u[0]) <= 0.15 and abs(s.u[1]) <= 0.3 and s.periods == 10 for s in samples)
    # it walked: a second under the fastest of the inputs goes somewhere, and a tenth of a second is off by less than three of its steps
    fastest = max(samples, key=lambda s: abs(s.u[0]))
    gone = sum((b - a) ** 2 for a, b in zip(fastest.start[:2], fastest.held[:2], strict=True)) ** 0.5
    assert gone > 0.5 * abs(fastest.u[0])
    assert 0.0 < gap["radius"] < 0.048


def test_its_log_passes_the_audit_and_gives_the_same_gap_again(campaign: tuple[Path, Path, dict[str, object]]) -> None:
    folder, profile, answer = campaign
    audited = s2r("audit", folder / "walk.mcap", "--json", folder=folder)
    assert (audited.returncode, json.loads(audited.stdout)["ok"]) == (0, True), audited.stdout
    options = ("--epsilon", "0.5", "--beta", "0.5", "--json")
    again = json.loads(s2r("gap", folder / "walk.mcap", "--profile", profile, *options, folder=folder).stdout)
    assert again["radius"] == answer["gap"]["radius"]  # type: ignore[index]
    assert again["radius_literal"] >= again["radius"]


def test_the_demo_knows_its_story() -> None:
    robot = registry().get("robots", "quadruped")
    assert "weak_leg" in robot.story.effects[0]
    assert "dt = 1.0" in robot.profile_text("tcp/127.0.0.1:1", "tcp/127.0.0.1:2")
    assert robot.command(1, [])[-2:] == ["--period", "1"]
    assert robot.controller("good").name == "quadruped_grid.py"
