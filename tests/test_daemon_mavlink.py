"""The daemon with the stand-in rover over real MAVLink on loopback: campaign, drive, a person's hand, others on the line, and the audit."""

from __future__ import annotations

import itertools
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mavlink_rig import MavlinkRig

from s2r_runtime.messages import Decided, GateChanged, Observed, OverrideChanged, Send

pytest.importorskip("s2r_mavlink")

from mavlink_floods import FLOODS, HELD_MAX_S, Flood, held_s
from pymavlink.dialects.v20 import common as mavlink


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[MavlinkRig]:
    opened = MavlinkRig(tmp_path)
    yield opened
    opened.close()


def circle(rig: MavlinkRig) -> Path:
    return rig.controller("    return np.tile([0.4, 0.6], (len(x), 1))\n")


@pytest.mark.slow
def test_campaign_drive_a_persons_hand_and_audit_over_mavlink(tmp_path: Path) -> None:
    rig = MavlinkRig(tmp_path, "tcp")
    try:
        rig.start()
        rig.ready()
        answer = rig.deploy(circle(rig))
        assert answer["exit_code"] == 0, answer
        rig.until(rig.moved)
        rig.rover.tell("mode MANUAL")
        rig.until(lambda: rig.status()["latched"] == ["manual_override"])
        assert rig.status()["gate"] == "closed"
        assert rig.ask("clear", text="manual_override")["exit_code"] == 0
        rig.ready()
        answer = rig.sample()
        assert answer["exit_code"] == 0, answer
        assert rig.ask("stop")["exit_code"] == 0
        rig.until(lambda: [line["mode"] for line in rig.rover.said if "mode" in line][-1] == "HOLD")
        assert rig.stop() == 0
        found = rig.audit()
        assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found
        sent = [m for m in rig.messages("out/send") if isinstance(m, Send)]
        assert {m.source for m in sent} == {"controller", "sampler", "recovery"}
        (override,) = (m for m in rig.messages("event/override_changed") if isinstance(m, OverrideChanged))
        assert override.detail == "the robot was taken over: MANUAL, armed"
        assert "the robot can be driven" in rig.said()
        assert "every 25 ms" in rig.said()
    finally:
        rig.close()


def test_no_sample_is_taken_from_a_robot_that_does_not_obey(tmp_path: Path) -> None:
    rig = MavlinkRig(tmp_path, "udp", "", "--prearm-fails")
    try:
        rig.start()
        rig.until(lambda: rig.status()["observation"])
        answer = rig.sample()
        assert answer["exit_code"] == 1
        assert "observation_invalid" in answer["text"]
        rig.until(lambda: "the robot says: Arm: GPS 1: Bad fix" in rig.said())
        assert rig.status()["observation"]["fault"] == "the robot can't be driven: GUIDED, disarmed"
    finally:
        rig.close()


@pytest.mark.slow
def test_controller_of_somebody_else_is_refused_and_told_so_while_ours_drives(rig: MavlinkRig) -> None:
    rig.start()
    rig.ready()
    assert rig.deploy(circle(rig))["exit_code"] == 0
    rig.until_status(gate="open")
    mav, said = mavlink.MAVLink(None, 1, 195), []
    mav.robust_parsing = True
    with socket.create_connection(("127.0.0.1", rig.companion)) as companion:
        companion.settimeout(0.02)

        def told() -> bool:
            for _ in range(5):
                companion.sendall(mav.set_position_target_local_ned_encode(0, 1, 1, 8, 1479, 0, 0, 0, -1.0, 0, 0, 0, 0, 0, 0, 0).pack(mav))
            try:
                said.extend(m.text for m in mav.parse_buffer(companion.recv(1 << 16)) or [] if m.get_type() == "STATUSTEXT")
            except TimeoutError:
                return False
            return "s2r: refused external: source_not_allowed" in said

        rig.until(told)
    assert rig.status()["gate"] == "open"
    assert rig.stop() == 0
    refused = [m for m in rig.messages("out/decided") if isinstance(m, Decided) and m.source == "external"]
    assert refused
    assert {(m.allow, m.reason) for m in refused} == {(False, "source_not_allowed")}
    assert all(m.u[0] >= 0.0 for m in rig.messages("out/send") if isinstance(m, Send) and m.source == "controller")
    assert rig.audit()["ok"]


@pytest.mark.slow
def test_signed_robot_is_driven_and_the_audit_needs_no_key(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text(os.urandom(32).hex())
    key.chmod(0o600)
    more = f'signing_key_file = "{key}"\nsigning_state = "{tmp_path}/signing.json"'
    rig = MavlinkRig(tmp_path, "udp", more, "--key-file", str(key))
    try:
        rig.start()
        rig.ready()
        assert rig.deploy(circle(rig))["exit_code"] == 0
        rig.until(rig.moved)
        assert rig.stop() == 0
        key.unlink()
        found = rig.audit()
        assert (found["ok"], found["first_difference"]) == (True, None), found
    finally:
        rig.close()


def test_robot_that_starts_anew_in_a_campaign_is_not_sampled_across_it(rig: MavlinkRig) -> None:
    rig.start()
    rig.ready()
    rig.ask("permit", duration_s=3600.0)
    heard: list[dict[str, Any]] = []

    def reboot_after_a_while() -> None:
        rig.until(lambda: rig.status()["phase"] == "hold")
        rig.rover.tell("reboot")

    thread = threading.Thread(target=reboot_after_a_while)
    thread.start()
    answer = rig.ask("sample", heard)
    thread.join()
    assert answer["exit_code"] == 1
    assert "manual_override" in answer["text"]
    assert rig.ask("clear", text="manual_override")["exit_code"] == 0
    rig.ready()
    assert rig.ask("sample")["exit_code"] == 0, "the campaign goes on where it was"
    assert rig.stop() == 0
    observed = [m.observation for m in rig.messages("event/observed") if isinstance(m, Observed)]
    good = [o for o in observed if not o.fault]
    assert all(b.stamp_ns > a.stamp_ns and b.seq > a.seq for a, b in itertools.pairwise(good))
    changes = [m.reason for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged)]
    assert "manual_override" in changes
    assert rig.audit()["ok"]


@pytest.mark.slow
@pytest.mark.parametrize("flood", FLOODS.values(), ids=FLOODS)
def test_flood_holds_the_loop_for_no_longer_than_it_may_and_the_robot_is_driven_on(tmp_path: Path, flood: Flood) -> None:
    held, gate = held_s(tmp_path, flood, 2.0)
    assert held <= HELD_MAX_S
    assert gate == "open"
