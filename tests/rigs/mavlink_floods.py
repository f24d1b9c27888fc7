"""Floods against a daemon that drives a MAVLink robot, and for how long each holds the loop that runs the gate."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx as crc16
from mavlink_rig import MavlinkRig
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink.dialect import CRC_EXTRA, HEARTBEAT

HELD_MAX_S = 0.02
"""The promise, of processor time: what other work on the machine adds is not the flood's."""
PAUSE_S = 0.0005


class Flood(NamedTuple):
    """data: sent again and again. to: `companion` (TCP) or `robot` (UDP). connections: at once. guests: who listen as companions."""

    data: bytes
    to: str = "companion"
    connections: int = 1
    guests: int = 0


def _shortest(system: int, component: int) -> bytes:
    """A heartbeat in the eight bytes of version 1."""
    body = bytes((0, 0, system, component, HEARTBEAT))
    return b"\xfe" + body + crc16(body + bytes([CRC_EXTRA[HEARTBEAT]])).to_bytes(2, "little")


def _setpoint() -> bytes:
    mav = mavlink.MAVLink(None, 1, 195)
    return bytes(mav.set_position_target_local_ned_encode(0, 1, 1, 8, 1479, 0, 0, 0, -1.0, 0, 0, 0, 0, 0, 0, 0).pack(mav))


NOISE = b"\xfe"
"""Each byte may begin a frame of 262 bytes, and none does."""
FLOODS = {
    "one companion, shortest frames": Flood(_shortest(9, 9)),
    "eight companions, shortest frames": Flood(_shortest(9, 9), connections=8),
    "one companion, setpoints": Flood(_setpoint()),
    "one companion, noise": Flood(NOISE),
    "eight companions, noise": Flood(NOISE, connections=8),
    "robot's port, shortest frames": Flood(_shortest(9, 9), "robot", guests=7),
    "robot's port, frames in the robot's name": Flood(_shortest(1, 1), "robot", guests=7),
    "robot's port, noise": Flood(NOISE, "robot", guests=7),
}


def held_s(folder: Path, flood: Flood, seconds: float) -> tuple[float, str]:
    """The longest processor time of a turn of the loop, s, and how the gate stands after the flood, while a controller drives."""
    rig = MavlinkRig(folder)
    try:
        rig.start("--held", str(folder / "held"))
        rig.ready()
        answer = rig.deploy(rig.controller("    return np.tile([0.4, 0.6], (len(x), 1))\n"))
        assert answer["exit_code"] == 0, answer
        rig.until_status(gate="open")
        found = re.search(r'robot = "udp:127.0.0.1:(\d+)"', rig.profile.read_text())
        assert found
        with _guests(rig.companion, flood.guests):
            port = rig.companion if flood.to == "companion" else int(found[1])
            process = multiprocessing.get_context("spawn").Process(target=_send, args=(flood, port), daemon=True)
            process.start()
            time.sleep(seconds)
            gate = str(rig.status()["gate"])
            process.kill()
            process.join()
        assert rig.stop() == 0
        return max(json.loads((folder / "held").read_text()).values()), gate
    finally:
        rig.close()


@contextlib.contextmanager
def _guests(port: int, number: int) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for _ in range(number):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        yield


def _send(flood: Flood, port: int) -> None:
    """Until it is killed."""
    tcp = flood.to == "companion"
    ends = [socket.socket(socket.AF_INET, socket.SOCK_STREAM if tcp else socket.SOCK_DGRAM) for _ in range(flood.connections)]
    for end in ends:
        end.connect(("127.0.0.1", port))
        end.setblocking(False)
    piece = flood.data * ((60_000 if tcp else 9000) // len(flood.data))
    while True:
        for end in ends:
            with contextlib.suppress(BlockingIOError):
                end.send(piece)
        time.sleep(PAUSE_S)
