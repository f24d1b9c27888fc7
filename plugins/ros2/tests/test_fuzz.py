"""A seeded share of tools/fuzz_ros2.py: no crash, and nothing accepted that no message said. And it can fail."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
from s2r_ros2 import cdr, pose

TOOL = Path(__file__).parents[3] / "tools" / "fuzz_ros2.py"
SPEC = importlib.util.spec_from_file_location("fuzz_ros2", TOOL)
assert SPEC is not None
assert SPEC.loader is not None
fuzz_ros2 = importlib.util.module_from_spec(SPEC)
sys.modules["fuzz_ros2"] = fuzz_ros2
SPEC.loader.exec_module(fuzz_ros2)


@pytest.mark.parametrize("rmw", [False, True], ids=["bridge", "rmw"])
@pytest.mark.parametrize("kind", ["odometry", "pose_stamped", "tf"])
def test_nothing_is_accepted_that_no_message_said(kind: str, rmw: bool) -> None:
    found = fuzz_ros2.fuzz(5000, 7, kind, rmw=rmw)
    assert found.lies == []
    assert found.observations > 500
    assert found.faults > 500


@pytest.mark.parametrize("what", ["length", "tilt", "left over", "encapsulation"])
def test_decoder_that_does_not_look_would_be_found_out(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if what == "length":
        monkeypatch.setattr(pose, "LENGTH_TOLERANCE", 10.0)
    elif what == "tilt":
        monkeypatch.setattr(pose.math, "acos", lambda _: 0.0)
    elif what == "left over":
        monkeypatch.setattr(cdr.Reader, "end", lambda _: None)
    else:
        monkeypatch.setattr(cdr, "ORDERS", {**cdr.ORDERS, b"\0\3": "<"})
    assert fuzz_ros2.fuzz(6000, 7, "odometry", rmw=False).lies != []
