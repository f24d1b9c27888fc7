"""`s2r demo --robot quadruped`, whole, in rigid-body physics: minutes of the processor, so it belongs to `make test-all`.

What its evidence demands differs with the effect and the seed: a controller that is refused for good is a story too. What may never
differ is held here: what was refused did not drive, a repair made the gap smaller, and the log passes the audit, controllers run again.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from s2r_runtime import messages as m
from s2r_runtime.recording.writer import read_all

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="the robot's physics are an extra: s2r-standins[sim]"),
    pytest.mark.slow,
    pytest.mark.timeout(5400),
]


@pytest.mark.parametrize(
    ("effect", "change"),
    [("weak_leg leg=rear_right strength=0.6", "payload mass=4"), ("payload mass=4", "weak_leg leg=rear_right strength=0.6")],
    ids=["weak leg", "payload"],
)
def test_the_story_ends_as_its_evidence_demands(tmp_path: Path, effect: str, change: str) -> None:
    out = tmp_path / "run"
    argv = [sys.executable, "-m", "s2r_runtime.cli.main", "demo", "--robot", "quadruped", "--out", str(out)]
    done = subprocess.run([*argv, "--effect", effect, "--change", change], capture_output=True, text=True, timeout=5000, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    log = [entry.message for entry in read_all(sorted((out / "logs").glob("*.mcap"))).entries()]
    gaps = [e.gap for e in log if isinstance(e, m.EpochChanged) and e.gap is not None]
    assert gaps, done.stdout
    if "model adopted" in done.stdout:
        assert gaps[1].hold_radius < gaps[0].hold_radius
    certified = False
    for e in log:
        if isinstance(e, m.CertificateInstalled):
            certified = True
        elif isinstance(e, m.Revoked):
            certified = False
        elif isinstance(e, m.Send) and e.source == "controller":
            assert certified
    assert "\nholds:" in done.stdout
    assert "still refused" in done.stdout or "the robot stays parked" in done.stdout or "the gate is closed" in done.stdout
    assert (out / "report.html").stat().st_size > 10_000
