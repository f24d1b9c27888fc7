"""Faults of real links under a running daemon: Zenoh, MAVLink over UDP, CAN (socketcand). Otherwise as `daemon_faults`.

The robot is `link_robot`: it lies, falls silent, leaves the link, comes back, counts from zero. Others speak beside it. Most of these
protocols carry no number or source of a command, so what reached the robot is judged by its inputs: those of the certified controller, or
zero; never more of them than the core sent.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import daemon_faults
from daemon_faults import BAD_U, FOREIGN_U, GOOD_U, Drill, lawful
from daemon_rig import Rig

from s2r_runtime.messages import GateChanged
from s2r_runtime.recording.glance import glance

PROGRAM = Path(__file__).with_name("link_robot.py")
KINDS = ("zenoh", "mavlink", "can")
RADIUS = 0.3
"""m. A robot in real time on a busy machine gets its commands late, which its model does not know."""
TELLS = 1e-5
"""A bus rounds inputs to so much at most."""


class LinkRig(Rig):
    """A rig whose robot is reached over one of the links."""

    def __init__(self, folder: Path, kind: str) -> None:
        super().__init__(folder, clock="realtime")
        self.kind, self._hub = kind, None
        self.options: dict[str, Any] = {"kind": kind}
        table = getattr(self, f"_{kind}")()
        text = self.profile.read_text().replace('[transport]\nname = "loop"\nfolder = "."\n', "")
        lines = [f"{name} = {toml(value)}" for name, value in {"name": kind, **table}.items()]
        self.profile.write_text(text + "\n[transport]\n" + "\n".join(lines) + "\n")

    def _zenoh(self) -> dict[str, Any]:
        from s2r_zenoh.testing import free_endpoint

        self.options["endpoint"], self.outside = free_endpoint(), free_endpoint()
        return {"robot_listen": self.options["endpoint"], "controller_listen": self.outside, "observation_timeout": 0.5}

    def _mavlink(self) -> dict[str, Any]:
        import socket

        from s2r_mavlink.testing import free_port

        self.options["port"], self.companion = free_port(), free_port(socket.SOCK_STREAM)
        line = f"udp:127.0.0.1:{self.options['port']}"
        return {"robot": line, "companion": f"tcpin:127.0.0.1:{self.companion}", "observation_timeout": 0.5, "max_age": 0.6}

    def _can(self) -> dict[str, Any]:
        from s2r_can.hub import Hub
        from s2r_can.testing import CLASSIC, options_of

        self._hub = Hub().start()
        bus = {"interface": "socketcand", "host": "127.0.0.1", "port": self._hub.port, "channel": "r", "tcp_tune": True}
        self.options["bus"], self.outside = bus, {**bus, "channel": "c"}
        (self.folder / "rig.dbc").write_text(CLASSIC)
        more = {"controller": self.outside, "dbc": "rig.dbc", "observation_timeout": 0.5, "message_timeout": 0.4}
        return {**options_of(CLASSIC, bus), **more}

    def start_robot(self, *_: str) -> None:
        argv = [sys.executable, str(PROGRAM), str(self.folder), json.dumps(self.options)]
        with (self.folder / "robot.txt").open("ab") as sink:
            self.robot = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=sink, stderr=sink)

    def tell(self, **what: Any) -> None:
        """A line on the robot's stdin."""
        assert self.robot is not None
        assert self.robot.stdin is not None
        self.robot.stdin.write(json.dumps(what).encode() + b"\n")
        self.robot.stdin.flush()

    def certificate(self, controller: Path, *, radius: float = RADIUS, verified: float = RADIUS, epoch: int = 1) -> str:
        return super().certificate(controller, radius=RADIUS, verified=max(verified, RADIUS), epoch=epoch)

    def close(self) -> None:
        super().close()
        if self.robot is not None and self.robot.stdin is not None:
            self.robot.stdin.close()
        if self._hub is not None:
            self._hub.close()


def toml(value: Any) -> str:
    """A value of a profile."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(name)} = {toml(one)}" for name, one in value.items()) + " }"
    return json.dumps(value)


class LinkDrill(Drill):
    """One robot on one link, and its faults."""

    GROWN = RADIUS

    def __init__(self, folder: Path, kind: str, seed: int = 1) -> None:
        self.rig: LinkRig
        super().__init__(folder, seed=seed, rig=LinkRig(folder, kind))

    def reasons(self) -> list[str]:
        """What the gate said since the fault, by the logs."""
        told = [one for path in self.rig.log_files() for one in glance(path, ("out/gate_changed",))]
        return [one.reason.removeprefix("latched:") for one in told[self._before :] if isinstance(one, GateChanged)]

    def run(self, name: str) -> daemon_faults.Outcome:
        """As `Drill.run`, of the faults here."""
        self._before = 0
        self._before = len(self.reasons())
        begun = time.monotonic()
        LINK_FAULTS[name](self)
        self.drive()
        found = [one for one in dict.fromkeys(self.reasons()) if one not in (daemon_faults.gate.ALLOWED, "settling")]
        assert set(found) <= set(daemon_faults.gate.REASONS), found
        return daemon_faults.Outcome(f"{self.rig.kind}: {name}", found, time.monotonic() - begun)


# ---------------------------------------------------------------- what the link does


def _lie(*reasons: str, **lie: Any) -> Callable[[LinkDrill], None]:
    """It says something else for a few periods; what must be said of it, where every link must notice."""

    def fault(drill: LinkDrill) -> None:
        drill.rig.tell(lie=lie)
        if reasons:
            drill.says(*reasons)
        time.sleep(0.5)

    return fault


def _garbage(drill: LinkDrill) -> None:
    counters = drill.rig.status()["counters"]
    drill.rig.tell(garbage=[0, 1, 3, 8, 8, 8, 8, 40, 64])
    drill.rig.until(lambda: drill.rig.status()["counters"] != counters)


def _away(seconds: float) -> Callable[[LinkDrill], None]:
    def fault(drill: LinkDrill) -> None:
        drill.rig.tell(away=seconds)
        drill.says("link_down", "observation_stale")

    return fault


def _reboot(drill: LinkDrill) -> None:
    """Its numbers and its clock begin anew: no observation of before passes for one of now."""
    drill.rig.tell(reboot=True)
    time.sleep(1.0)


def _hand(drill: LinkDrill) -> None:
    drill.rig.tell(hand=True)
    drill.says("emergency_stop", "manual_override")
    drill.rig.tell(hand=False)


# ---------------------------------------------------------------- others on it


def _outsider(drill: LinkDrill) -> None:
    """Somebody commands where others may speak: refused, and the robot does not hear it."""
    {"zenoh": _zenoh_proposal, "mavlink": _companion, "can": _node_outside}[drill.rig.kind](drill.rig)
    assert drill.rig.status()["gate"] == "open" or drill.reasons()


def _zenoh_proposal(rig: LinkRig) -> None:
    from s2r_zenoh.testing import session

    before = rig.status()["counters"]["proposals"]
    with session("client", connect=rig.outside) as outsider:
        data = json.dumps({"input": {"v": 0.0, "w": FOREIGN_U}, "seq": 1, "obs_seq": 1})
        rig.until(lambda: outsider.put("s2r/robot/proposal", data) or rig.status()["counters"]["proposals"] > before)
        for key in ("s2r/robot/command", "s2r/robot/observation"):  # what only the runtime, and only the robot, may say
            outsider.put(key, data)
        time.sleep(0.3)


def _companion(rig: LinkRig) -> None:
    import socket

    from pymavlink.dialects.v20 import common as mavlink

    mav, before = mavlink.MAVLink(None, 1, 195), rig.status()["counters"]["companion_refused"]
    with socket.create_connection(("127.0.0.1", rig.companion)) as line:

        def told() -> bool:
            line.sendall(mav.set_position_target_local_ned_encode(0, 1, 1, 8, 1479, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, -FOREIGN_U).pack(mav))
            return bool(rig.status()["counters"]["companion_refused"] > before)

        rig.until(told)


def _node_outside(rig: LinkRig) -> None:
    import can
    from s2r_can.testing import CLASSIC, Robot

    before, robot = rig.status()["counters"]["proposals"], Robot({}, CLASSIC)
    values = {"V": 0.0, "W": FOREIGN_U, "Enable": 1, "DriveChecksum": 0}
    with can.Bus(ignore_config=True, **rig.outside) as node:
        for counter in range(20):
            node.send(robot.frame("Drive", {**values, "DriveCounter": counter % 16}))
            time.sleep(0.01)
        rig.until(lambda: rig.status()["counters"]["proposals"] > before)


def _same(name: str) -> Callable[[LinkDrill], None]:
    """A fault of `daemon_faults` that is none of the transport's."""
    return daemon_faults.FAULTS[name]  # type: ignore[return-value]


LINK_FAULTS: dict[str, Callable[[LinkDrill], None]] = {
    "link cut for 2 s": _away(2.0),
    "link cut for 5 s": _away(5.0),
    "robot restarted": _reboot,
    "robot away and restarted": lambda drill: (_away(2.0)(drill), _reboot(drill))[0],
    "robot killed": _same("robot killed"),
    "robot frozen": _same("robot frozen"),
    "garbage": _garbage,
    "observation not finite": _lie("observation_invalid", x=["nan", 0.0, 0.0]),
    "observation infinite": _lie("observation_invalid", "outside_region", x=[0.0, "-inf", 0.0]),
    "observation outside": _lie("outside_region", "observation_invalid", x=[900.0, 0.0, 0.0]),
    "observation stale": _lie(behind_s=20.0),
    "observation out of order": _lie(later=-7, behind_s=7 * 0.033),
    "observation repeated": _lie(copies=2),
    "observation of the future": _lie(later=500, behind_s=-1e4, times=1),
    "a person's hand": _hand,
    "an outsider commands": _outsider,
    "second daemon": _same("second daemon"),
    "daemon killed": _same("daemon killed"),
    "daemon ended": _same("daemon ended"),
    "daemon stopped for 1 s": _same("daemon stopped for 1 s"),
    "controller raises": _same("controller raises"),
    "controller killed": _same("controller killed"),
    "controller without a certificate": _same("controller without a certificate"),
    "analytics killed": _same("analytics killed"),
    "disk full": _same("disk full"),
    "state truncated": _same("state truncated"),
    "stop": _same("stop"),
    "revoked": _same("revoked"),
}


def judged(drill: LinkDrill) -> dict[str, int]:
    """Every event by the law, and every command that reached the robot by its inputs."""
    sent, count = lawful(drill)
    moved = 0
    for command in drill.rig.applied():
        count["commands"] += 1
        v, w = command["u"]
        near = [good for good in (0.0, GOOD_U, BAD_U) if math.isclose(v, 0.0, abs_tol=TELLS) and math.isclose(w, good, abs_tol=TELLS)]
        assert near, command
        moved += near != [0.0]
    # a killed daemon's last 100 ms may be missing in the log, and as much of a busy machine
    ordered = sum(any(one.u) for one in sent)
    assert moved <= ordered + 30 * drill.killed, (moved, ordered)
    return count
