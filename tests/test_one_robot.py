"""One robot behind every transport: the same body, seed and lockstep time give the same gap, certificate and audit.

What a protocol rounds is all that may differ. With q the largest rounding of a state, in the norm, and p that of an input over one step,
the measured discrepancy x1 - f(x0, u) of a sample moves by at most

    q  (of x1)  +  (1 + v dt) q  (of x0, through the model)  +  p  (of what the robot makes of its command)

and the radius, an order statistic of the discrepancies, by no more than each of them does. Beyond the robot's own rounding nothing adds up:
a sample begins with what is measured, and random inputs come from the seed.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.core import ledger
from s2r_runtime.daemon.campaign_run import run_campaign
from s2r_runtime.evidence import seeds
from s2r_runtime.profile import load_profile

pytest.importorskip("s2r_can")
pytest.importorskip("s2r_mavlink")
pytest.importorskip("s2r_ros2")
pytest.importorskip("s2r_zenoh")

from s2r_can.testing import SocketRig
from s2r_mavlink.testing import MavlinkRig
from s2r_ros2.testing import Ros2Rig
from s2r_standins.body import Body, DataSheet
from s2r_zenoh.testing import ZenohRig

ROOT = Path(__file__).parent.parent
DT, LEVER, SPEED = 0.05, 0.0525, 0.2
PROFILE = """
clock = "lockstep"
[robot]
name = "one"
[model]
name = "unicycle"
dt = 0.05
[[model.effects]]
name = "input_delay"
channel = "*"
parameters = { delay = 0.05 }
[[model.effects]]
name = "wheel_saturation"
channel = "*"
parameters = { speed = 0.2, track = 0.105 }
[region]
x = [-1.6, 1.6]
y = [-1.0, 1.0]
[inputs]
v = [-0.2, 0.2]
w = [-3.1, 3.1]
[norm]
weights = { theta = 0.0525 }
[sampling]
hold_periods = 5
[guarantee]
epsilon = 0.3
beta = 0.5
[verification]
epsilon = 0.3
[task]
name = "keep_out"
[transport]
"""


class Rounding(NamedTuple):
    """Largest error of what the protocol makes of a length (m), an angle (rad), a speed (m/s), a yaw rate (rad/s)."""

    length: float = 0.0
    angle: float = 0.0
    speed: float = 0.0
    rate: float = 0.0

    def radius(self) -> float:
        """By how much it may move the gap's radius, m."""
        q = math.sqrt(2.0 * self.length**2 + (LEVER * self.angle) ** 2)
        through = q + SPEED * DT * self.angle
        return q + through + DT * math.hypot(self.speed, LEVER * self.rate) + 1e-12


HALF = 2.0**-24
"""Relative rounding of single precision; lengths here are below 2 m, angles and rates below 4."""
ROBOTS: dict[str, tuple[str, Callable[[], Any], Rounding]] = {
    "zenoh": ("zenoh", ZenohRig, Rounding()),
    "can": ("can", SocketRig, Rounding(0.5e-6, 0.5e-7, 0.5e-6, 0.5e-6)),
    "mavlink": ("mavlink", lambda: MavlinkRig("tcp"), Rounding(2.0 * HALF, 4.0 * HALF, 0.25 * HALF, 4.0 * HALF)),
    "ros2": ("ros2", lambda: Ros2Rig(period=DT), Rounding(angle=4.0 * 2.0**-52)),
}


class Lockstep(threading.Thread):
    """The Robotarium's body at a robot's end: it says where it is and drives one period by the command that comes back."""

    def __init__(self, end: Any) -> None:
        super().__init__(daemon=True)
        self._end, self._over = end, threading.Event()
        self._body = Body(DataSheet(dt=DT, integration="euler"), (0.0, 0.0, 0.0), seed=3)
        self._body.switch_on("input_gain:w gain=0.9")

    def run(self) -> None:
        """Until the first command that moves it nothing is measured anew: the campaign begins when the daemon comes to it."""
        k, x, moved = 0, self._body.observe(), False
        while not self._over.is_set():
            k += 1
            while (command := self._answer(k, x)) is None and moved and not self._over.is_set():
                pass
            moved = moved or command not in (None, (0.0, 0.0))
            if command is not None and moved:
                self._body.move(command)
                x = self._body.observe()

    def _answer(self, k: int, x: tuple[float, float, float]) -> tuple[float, float] | None:
        self._end.publish(k, round(k * DT * 1e9), x)
        again = time.monotonic() + 0.3
        while time.monotonic() < again and not self._over.is_set():
            if commands := self._end.received():
                return commands[-1].u
            time.sleep(0.0005)
        return None

    def end(self) -> None:
        self._over.set()
        self.join(10.0)


def toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(v)}" for key, v in value.items()) + " }"
    return json.dumps(value)


class Outcome(NamedTuple):
    n: int
    radius: float
    certified: dict[str, Any]
    audit: tuple[bool, Any, str]


def outcome(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> Outcome:
    """What a campaign, a certificate on its gap and the audit of its log say."""
    transport, make, _ = ROBOTS[name]
    with make() as rig:
        options = {"name": transport, **rig.options, "observation_timeout": 30.0}
        if transport == "can":
            (folder / "rig.dbc").write_text(options["dbc"]["text"])
            options |= {"dbc": "rig.dbc", "message_timeout": 30.0}
        path, log = folder / "one.toml", folder / "one.mcap"
        path.write_text(PROFILE + "".join(f"{key} = {toml(value)}\n" for key, value in options.items()))
        robot = Lockstep(rig.robot)
        robot.start()
        try:
            campaign = run_campaign(load_profile(path), path, log, state_dir=folder / "state", seed=11)
        finally:
            robot.end()
    assert campaign["exit_code"] == 0, campaign
    gap = campaign["gap"]
    capsys.readouterr()
    law, key = str(ROOT / "controllers" / "keep_out.py"), str(folder / "state" / "key.pem")
    asked = [
        "certify",
        law,
        "--profile",
        str(path),
        "--recording",
        str(log),
        "--key",
        key,
        "-o",
        str(folder / "certificate.json"),
        "--json",
    ]
    assert main(asked) == 0
    shown = json.loads(capsys.readouterr().out)
    laws = {law: (found["n"], found["failures"], found["passed"]) for law, found in shown["laws"].items()}
    certified = {"passed": shown["passed"], "headroom": round(shown["radius"] / gap["radius"], 6), "seed": shown["seed"], **laws}
    assert main(["audit", str(log), "--json"]) in (0, 1)
    audited = json.loads(capsys.readouterr().out)
    return Outcome(gap["n"], gap["radius"], certified, (audited["ok"], audited["first_difference"], audited["chain"]))


@pytest.mark.slow
def test_the_same_robot_behind_every_transport_has_the_same_gap_certificate_and_audit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # a campaign's seed is drawn from the profile's digest too, and the profile names the transport
    drawn = ledger.seed
    monkeypatch.setattr(ledger, "seed", lambda *parts: drawn(*(part for part in parts if not str(part).startswith("sha256:"))))
    monkeypatch.setattr(seeds, "drawn", lambda: 20_261_128)  # and that of a verification from the operating system
    found = {}
    for name in ROBOTS:
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
        monkeypatch.setenv("XDG_STATE_HOME", str(folder / "home"))
        found[name] = outcome(name, folder, capsys)
    exact = found["zenoh"]
    assert exact.audit == (True, None, "intact")
    assert exact.radius > 10.0 * max(rounding.radius() for _, _, rounding in ROBOTS.values()), "or the comparison says nothing"
    for name, (_, _, rounding) in ROBOTS.items():
        assert (found[name].n, found[name].certified, found[name].audit) == (exact.n, exact.certified, exact.audit), name
        assert abs(found[name].radius - exact.radius) <= rounding.radius(), name
