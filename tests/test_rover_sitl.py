"""The daemon on a real autopilot: ArduPilot Rover in its own simulator. Skipped where that is absent (`rover_sitl.find_folder`)."""

from __future__ import annotations

import itertools
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_rig import Rig

pytest.importorskip("s2r_mavlink")

import rover_sitl
from rover_sitl import Client, Simulator, profile_text
from s2r_mavlink.testing import free_port

from s2r_runtime.messages import GateChanged, Observed, OverrideChanged, SampleTaken, Send

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "profiles" / "rover-mavlink.toml"
MANUAL = 0
MAVPROXY = Path(sys.executable).with_name("mavproxy.py")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not rover_sitl.is_available(), reason="no simulator of ArduPilot here (S2R_SITL)"),
]


class SitlRig(Rig):
    """The shipped profile, a robot's name of its own, and the simulator's address."""

    def __init__(self, folder: Path, address: str) -> None:
        super().__init__(folder, clock="realtime")
        self.profile.write_text(profile_text(PROFILE, "rig", address))

    def ready(self) -> None:
        """Until the robot can be driven."""
        self.until(lambda: (seen := self.status()["observation"]) and not seen["fault"])

    def begin_campaign(self) -> None:
        """Until the sampler drives."""
        assert self.ask("permit", duration_s=3600.0)["exit_code"] == 0
        self.background("sample")
        self.until(lambda: self.status()["phase"])

    def taken(self) -> int:
        """Samples of the campaign so far."""
        return int((self.status()["campaign"] or {}).get("taken", 0))

    def audit(self) -> None:
        for log in self.log_files():
            found = json.loads(self.s2r("audit", str(log), "--key", str(self.state / "key.pub"), "--json").stdout)
            assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulator]:
    with Simulator(tmp_path_factory.mktemp("sitl"), rover_sitl.find_folder()) as opened:
        yield opened


@pytest.fixture
def rig(tmp_path: Path, simulator: Simulator) -> Iterator[SitlRig]:
    opened = SitlRig(tmp_path, simulator.address)
    yield opened
    opened.close()


def test_link_arm_three_samples_stop_and_audit_on_a_real_autopilot(rig: SitlRig) -> None:
    rig.start()
    rig.ready()
    rig.begin_campaign()
    rig.until(lambda: rig.taken() >= 3)
    assert rig.ask("stop")["exit_code"] == 0
    rig.until(lambda: rig.status()["observation"]["fault"] == "the robot can't be driven: HOLD, armed")
    assert rig.stop() == 0
    rig.audit()
    sent = [m for m in rig.messages("out/send") if isinstance(m, Send)]
    assert {m.source for m in sent} == {"sampler", "recovery"}
    samples = [m for m in rig.messages("out/sample_taken", "event/sample_taken") if isinstance(m, SampleTaken)]
    assert len(samples) >= 3


@pytest.mark.slow  # two minutes of real time, in which the autopilot must get its share of the processor
def test_second_ground_station_mode_change_and_restart_of_a_real_autopilot(rig: SitlRig, simulator: Simulator) -> None:
    rig.start()
    rig.ready()
    rig.begin_campaign()
    station = Client(simulator.port + 2)
    station.set_streams(2)
    rig.until(lambda: "comes less often than granted; asked for again" in rig.said())
    rig.until(lambda: rig.taken() >= 1)  # at the rate that was asked for again
    station.set_mode(MANUAL)
    station.close()
    rig.until_status(latched=["manual_override"])
    assert rig.ask("clear", text="manual_override")["exit_code"] == 0
    rig.ready()
    rig.begin_campaign()
    simulator.kill()
    rig.until_status(link=False)
    simulator.start()
    rig.until(lambda: "the robot's clock began anew" in rig.said())
    rig.until_status(latched=["manual_override"])
    assert rig.ask("clear", text="manual_override")["exit_code"] == 0
    rig.ready()
    rig.begin_campaign()
    rig.until(lambda: rig.taken() >= 2)
    assert rig.stop() == 0
    details = [m.detail for m in rig.messages("event/override_changed") if isinstance(m, OverrideChanged)]
    assert details[0] == "the robot was taken over: MANUAL, armed"
    assert details[1] in (  # which one is up to whether its heartbeat or its clock comes first
        "the robot started anew while it was driven",
        "the robot was taken over: INITIALISING, disarmed",
    )
    assert len(details) == 2
    good = [m.observation for m in rig.messages("event/observed") if isinstance(m, Observed) and not m.observation.fault]
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(good))
    rig.audit()


@pytest.mark.skipif(not MAVPROXY.is_file(), reason="MAVProxy is not installed here (pip install MAVProxy)")
def test_real_autopilot_is_sampled_through_mavproxy(tmp_path: Path, simulator: Simulator) -> None:
    out = free_port(socket.SOCK_DGRAM)
    rig = SitlRig(tmp_path, f"udp:127.0.0.1:{out}")
    with (tmp_path / "mavproxy.txt").open("wb") as said:
        argv = [sys.executable, str(MAVPROXY), "--master", simulator.address, "--out", f"127.0.0.1:{out}", "--daemon"]
        proxy = subprocess.Popen([*argv, "--cmd", "set streamrate -1"], stdin=subprocess.DEVNULL, stdout=said, stderr=said, cwd=tmp_path)
    try:
        rig.start()
        rig.ready()
        rig.begin_campaign()
        rig.until(lambda: rig.taken() >= 1)
        assert rig.stop() == 0
        rig.audit()
        assert not [m for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged) and m.reason == "robot_twin"]
    finally:
        proxy.kill()
        proxy.wait()
        rig.close()
