"""A daemon with a robot that speaks ROS 2 over Zenoh."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from daemon_rig import Rig
from s2r_ros2.keys import Layout
from s2r_zenoh.testing import free_endpoint

from s2r_runtime.messages import OverrideChanged

ROOT = Path(__file__).parents[2]

QUICK = {
    "hold_periods = 20": "hold_periods = 5",
    "stop_periods = 4": "stop_periods = 4\nwaypoint_radius = 0.3\nposition_gain = 3.0",
    "epsilon = 0.03\nbeta = 0.05": "epsilon = 0.3\nbeta = 0.5",
    "[verification]\nepsilon = 0.03": "[verification]\nepsilon = 0.3",
    "controller_deadline = 0.04": "controller_deadline = 0.5",
    "observation_timeout = 0.2     # s: four periods": "observation_timeout = 0.5",
    "command_ttl = 0.15 ": "command_ttl = 0.5 ",
    'name = "turtlebot-ros2-zenoh"\ndescription': 'name = "rig"\ndescription',
    "robot_radius = 0.105, steps = 400": (
        "robot_radius = 0.105, steps = 400, x_low = -1.0, x_high = 1.0, y_low = -1.0, y_high = 1.0, disc_radius = 0.15, min_distance = 0.8"
    ),
    # a stand-in that is eager has a clock that runs as fast as it is answered
    "observation_timeout = 0.3     # s without a pose": "max_age = 100.0\nobservation_timeout = 0.5     # s without a pose",
}
"""What makes the profile's campaign short: few samples, close together; and long time-outs, for a busy machine."""


class Ros2Rig(Rig):
    """As `Rig`, with the stand-in and the profile `turtlebot-ros2-zenoh`, on ports of the test's own."""

    def __init__(self, folder: Path, layout: str = "bridge", command: str = "twist", half: float = 1.0) -> None:
        """half: of the region's sides, m; in real time a small one is soon crossed."""
        super().__init__(folder, clock="realtime")
        self.layout, self.command = Layout(layout), command
        self.near, self.far = free_endpoint(), free_endpoint()
        text = (ROOT / "profiles" / "turtlebot-ros2-zenoh.toml").read_text()
        new = {
            'layout = "bridge" ': f'layout = "{layout}" ',
            'command = "twist" ': f'command = "{command}" ',
            "tcp/127.0.0.1:7447": self.near,
            "tcp/127.0.0.1:7448": self.far,
            "# emergency_stop =": "emergency_stop =",
            "x = [-1.6, 1.6]\ny = [-1.0, 1.0]": f"x = [-{half}, {half}]\ny = [-{half}, {half}]",
        }
        for old, put in {**QUICK, **new}.items():
            assert text.count(old) == 1, old
            text = text.replace(old, put)
        self.profile.write_text(text)

    def start_robot(self, *options: str) -> None:
        argv = [sys.executable, "-m", "s2r_ros2.standin", "--layout", self.layout.kind, "--command", self.command, "--listen", self.near]
        with (self.folder / "robot.txt").open("ab") as sink:
            self.robot = subprocess.Popen([*argv, "--parent", str(os.getpid()), *options], stdin=subprocess.PIPE, stdout=sink, stderr=sink)

    def tell(self, line: str) -> None:
        assert self.robot is not None
        assert self.robot.stdin is not None
        self.robot.stdin.write(line.encode() + b"\n")
        self.robot.stdin.flush()

    def law(self) -> Path:
        """The keep-out controller, for this robot's size."""
        text = (ROOT / "controllers" / "keep_out.py").read_text()
        assert text.count('"body": 0.055') == 1
        path = self.folder / "law.py"
        path.write_text(text.replace('"body": 0.055', '"body": 0.105'))
        return path

    def messages_of_overrides(self) -> set[str]:
        return {m.kind for m in self.messages("event/override_changed") if isinstance(m, OverrideChanged)}

    def close(self) -> None:
        super().close()
        if self.robot is not None and self.robot.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.robot.stdin.close()
