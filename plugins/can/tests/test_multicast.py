"""The transport over python-can's udp_multicast, in a network namespace of the test's own: multicast leaves the host otherwise.

Run inside one (S2R_CAN_NAMESPACE=1) this file tests; outside it only starts itself there.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest
from s2r_can.testing import MulticastRig, multicast_works

from s2r_runtime.messages import Command, Observation, OverrideChanged
from s2r_runtime.testing import TransportKit
from s2r_runtime.testing.transport_kit import Line

INSIDE = os.environ.get("S2R_CAN_NAMESPACE") == "1"
ENTER = ["unshare", "--map-root-user", "--net", "sh", "-ec"]
SETUP = 'ip link set lo up; ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo; exec "$0" "$@"'

inside = pytest.mark.skipif(not INSIDE, reason="runs in a network namespace of its own, started by the test below")


@pytest.mark.slow
@pytest.mark.skipif(INSIDE, reason="it is already there")
def test_everything_below_holds_in_a_namespace() -> None:
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        pytest.skip("needs unshare (util-linux) and ip (iproute2)")
    if subprocess.run([*ENTER, SETUP, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this user may not make a network namespace")
    done = subprocess.run(
        [*ENTER, SETUP, sys.executable, "-m", "pytest", str(Path(__file__)), "-p", "no:cacheprovider", "-q"],
        env={**os.environ, "S2R_CAN_NAMESPACE": "1"},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert " passed" in done.stdout or "." in done.stdout


@inside
class TestMulticast(TransportKit):
    rig = MulticastRig
    carries = ()


@inside
def test_frames_of_ones_own_come_back_and_are_taken_for_nobody_elses() -> None:
    assert multicast_works()
    with MulticastRig() as rig:
        rig.transport.open()
        line = Line(rig)
        line.link((0.0, 0.0, 0.0))
        for k in range(20):
            line.transport.send(line.transport.encode(Command(k, 0, "sampler", (0.1, 0.0), 1, 10**8)))
            line.turn()
        assert not [m for m in line.messages if isinstance(m, OverrideChanged)]
        assert line.transport.counters()["strangers"] == 0
        frame = next(iter(rig.robot.bus.recv(0.1) for _ in range(1)))
        assert frame is not None
        rig.robot.bus.send(can.Message(arbitration_id=2566849808 & 0x1FFFFFFF, data=bytes(20), is_fd=True))
        assert line.until(lambda: any(isinstance(m, OverrideChanged) for m in line.messages))


@inside
def test_datagrams_that_are_no_can_frames_harm_nobody() -> None:
    with MulticastRig() as rig:
        rig.transport.open()
        line = Line(rig)
        seq = line.link((0.0, 0.0, 0.0))
        where = (rig.options["robot"]["channel"], rig.options["robot"]["port"])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            for k in range(300):
                s.sendto(os.urandom(k % 100), where)
                if k % 30 == 0:
                    seq += 1
                    rig.robot.publish(seq, seq * 10_000_000, (0.5, 0.0, 0.0))
                    line.turn()
        assert line.until(lambda: line.reached(seq))
        assert line.transport.counters()["interface_errors"] > 0


@inside
def test_link_that_is_cut_with_the_interface_heals_within_a_second() -> None:
    with MulticastRig() as rig:
        rig.transport.open()
        line = Line(rig)
        seq = line.link((0.0, 0.0, 0.0))
        for _ in range(3):
            subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
            begin = time.monotonic()
            assert line.until(lambda: line.links[-1] is False)
            assert time.monotonic() - begin < 0.3 + 0.2
            subprocess.run(["sh", "-c", "ip link set lo up; ip route add 224.0.0.0/4 dev lo"], check=True)
            begin = time.monotonic()
            while not line.links[-1] and time.monotonic() < begin + 5.0:
                seq += 1
                try:
                    rig.robot.publish(seq, seq * 10_000_000, (0.5, 0.0, 0.0))
                except can.CanError:
                    rig.robot.close()
                line.turn()
            assert line.links[-1]
            assert time.monotonic() - begin < 1.0
        stamps = [m.stamp_ns for m in line.messages if isinstance(m, Observation) and not m.fault]
        assert stamps == sorted(set(stamps))
