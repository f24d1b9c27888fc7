"""A daemon with a robot that speaks MAVLink."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

from daemon_rig import Rig, made_up_certificate
from s2r_mavlink.testing import RoverProcess, free_port

PROFILE = """
clock = "realtime"
[robot]
name = "rig"
[model]
name = "unicycle"
dt = 0.1
[[model.effects]]
name = "input_rate_limit"
channel = "v"
parameters = {{ rate = 1.0 }}
[[model.effects]]
name = "input_rate_limit"
channel = "w"
parameters = {{ rate = 2.09 }}
[region]
x = [-4.0, 4.0]
y = [-4.0, 4.0]
[geofence]
x = [-6.0, 6.0]
y = [-6.0, 6.0]
[inputs]
v = [-1.0, 1.0]
w = [-1.0, 1.0]
[norm]
weights = {{ theta = 0.25 }}
[sampling]
hold_periods = 5
stop_periods = 15
waypoint_radius = 0.5
waypoint_margin = 0.5
position_gain = 0.5
heading_gain = 1.0
[guarantee]
epsilon = 0.3
beta = 0.5
[verification]
epsilon = 0.3
[gate]
controller_deadline = 0.5
command_ttl = 0.5
observation_timeout = 0.5
[task]
name = "keep_out"
[task.parameters]
x_low = -4.0
x_high = 4.0
y_low = -4.0
y_high = 4.0
[transport]
name = "mavlink"
robot = "{robot}"
rate = 40.0
take_over = "arm"
stop_mode = "HOLD"
max_age = 0.6
companion = "tcpin:127.0.0.1:{companion}"
{more}
"""


class MavlinkRig(Rig):
    """As `Rig`, with a rover whose time runs four times as fast."""

    def __init__(self, folder: Path, kind: str = "udp", more: str = "", *arguments: str) -> None:
        super().__init__(folder, clock="realtime")
        port, self.companion = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
        ours, theirs = ("udp", "udpout") if kind == "udp" else ("tcp", "tcpin")
        self.profile.write_text(PROFILE.format(robot=f"{ours}:127.0.0.1:{port}", companion=self.companion, more=more))
        self.rover = RoverProcess(f"{theirs}:127.0.0.1:{port}", "--speedup", "4", *arguments)

    def close(self) -> None:
        super().close()
        self.rover.end()

    def certificate(self, controller: Path, *, radius: float = 0.3, verified: float = 0.5, epoch: int = 1) -> str:
        return made_up_certificate(self.profile, self.state / "key.pem", controller, radius=radius, verified=verified, epoch=epoch)

    def ready(self) -> None:
        """Until the robot can be driven."""
        self.until(lambda: (seen := self.status()["observation"]) and not seen["fault"])

    def moved(self) -> bool:
        """Whether our controller has driven it somewhere."""
        x = self.status()["observation"]["x"]
        return len(x) == 3 and abs(x[0]) + abs(x[1]) > 0.3

    def audit(self) -> dict[str, Any]:
        (log,) = self.log_files()
        return dict(json.loads(self.s2r("audit", str(log), "--key", str(self.state / "key.pub"), "--json").stdout))
