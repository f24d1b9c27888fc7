"""A daemon with a robot over Zenoh."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from daemon_rig import Rig
from s2r_zenoh.testing import free_endpoint


class ZenohRig(Rig):
    """As `Rig`, with the built-in robot in lockstep and a profile that reaches it."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.endpoint, self.outside = free_endpoint(), free_endpoint()
        loop = 'name = "loop"\nfolder = "."\n'
        zenoh = f'name = "zenoh"\nrobot_listen = "{self.endpoint}"\ncontroller_listen = "{self.outside}"\n'
        self.profile.write_text(self.profile.read_text().replace(loop, zenoh))

    def start_robot(self, *options: str) -> None:
        argv = [sys.executable, "-m", "s2r_standins.robotarium", "--connect", self.endpoint, *options]
        with (self.folder / "robot.txt").open("ab") as sink:
            self.robot = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink)
