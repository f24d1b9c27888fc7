"""A daemon with a robot on a real CAN bus."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

from daemon_rig import Rig
from s2r_can.hub import Hub

ROOT = Path(__file__).parents[2]

QUICK = {
    "x = [-4.0, 4.0]\ny = [-3.0, 3.0]": "x = [-1.5, 1.5]\ny = [-1.5, 1.5]",
    "x = [-4.8, 4.8]\ny = [-3.8, 3.8]": "x = [-2.6, 2.6]\ny = [-2.6, 2.6]",
    "dt = 0.02 ": "dt = 0.05 ",
    "delay = 0.02 ": "delay = 0.05 ",
    "hold_periods = 50": "hold_periods = 5",
    "waypoint_radius = 0.3 ": "waypoint_radius = 0.4 ",
    "position_gain = 1.5 ": "position_gain = 3.0 ",
    "stop_periods = 25 ": "stop_periods = 10 ",
    "epsilon = 0.03\nbeta = 0.05": "epsilon = 0.3\nbeta = 0.5",
    "[verification]\nepsilon = 0.03": "[verification]\nepsilon = 0.3",
    "controller_deadline = 0.02": "controller_deadline = 0.5",
    "observation_timeout = 0.1     # s: five cycles": "observation_timeout = 0.5",
    "command_ttl = 0.06 ": "command_ttl = 0.5 ",
    'name = "amr-can"\ndescription': 'name = "rig"\ndescription',
    "x_low = -3.5, x_high = 3.5, y_low = -2.5, y_high = 2.5, disc_radius = 0.5, robot_radius = 0.3, min_distance = 2.5": (
        "x_low = -1.5, x_high = 1.5, y_low = -1.5, y_high = 1.5, disc_radius = 0.2, robot_radius = 0.1, min_distance = 1.2"
    ),
}
"""What makes the profile's campaign short: few samples, close together; and a slow base with long time-outs, for a busy machine."""

PARAMETERS = {"speed": 0.3, "body": 0.1, "margin": 0.15}


class CanRig(Rig):
    """As `Rig`, with the stand-in base and the profile `amr-can`, on a bus of the test's own."""

    def __init__(self, folder: Path, *, copies: bool = False) -> None:
        """copies: commands are repeated between two of them."""
        super().__init__(folder, clock="realtime")
        self.hub = Hub().start()
        common = {"interface": "socketcand", "host": "127.0.0.1", "port": self.hub.port, "tcp_tune": True}
        self.sides = {side: {**common, "channel": side} for side in ("r", "c")}
        text = (ROOT / "profiles" / "amr-can.toml").read_text()
        for old, new in QUICK.items():
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        for side, (channel, port) in {"r": ("239.74.163.10", 43310), "c": ("239.74.163.11", 43311)}.items():
            old = f'interface = "udp_multicast"\nchannel = "{channel}"\nport = {port}'
            assert text.count(old) == 1
            text = text.replace(old, "\n".join(f"{key} = {json.dumps(value)}" for key, value in self.sides[side].items()))
        if copies:
            text = text.replace('trigger = "Heading"', 'command_cycle = 0.02\ntrigger = "Heading"')
        self.profile.write_text(text + "\n[transport.timeouts]\nBaseStatus = 0.6\n")
        (folder / "amr-can.dbc").write_bytes((ROOT / "profiles" / "amr-can.dbc").read_bytes())

    def start_robot(self, *options: str) -> None:
        argv = [
            sys.executable,
            "-m",
            "s2r_can.standin",
            "--bus",
            json.dumps(self.sides["r"]),
            "--parent",
            str(os.getpid()),
            "--period",
            "0.05",
            *options,
        ]
        with (self.folder / "robot.txt").open("ab") as sink:
            self.robot = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=sink, stderr=sink)

    def tell(self, line: str) -> None:
        assert self.robot is not None
        assert self.robot.stdin is not None
        self.robot.stdin.write(line.encode() + b"\n")
        self.robot.stdin.flush()

    def law(self) -> Path:
        """The keep-out controller, for the small arena."""
        text = (ROOT / "controllers" / "keep_out_wheels.py").read_text()
        for name, value in PARAMETERS.items():
            line = next(line for line in text.splitlines() if line.startswith(f'    "{name}"'))
            text = text.replace(line, f'    "{name}": {value},')
        (self.folder / "keep_out.py").write_bytes((ROOT / "controllers" / "keep_out.py").read_bytes())
        path = self.folder / "law.py"
        path.write_text(text)
        return path

    def close(self) -> None:
        super().close()
        if self.robot is not None and self.robot.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.robot.stdin.close()
        self.hub.close()
