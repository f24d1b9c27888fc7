"""The daemon's life: it starts, answers, hears the robot, and ends with the robot recovered."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemon_rig import Rig

from s2r_runtime.daemon import control, door
from s2r_runtime.evidence.seen_rows import sketch, united
from s2r_runtime.files.toml_text import TEXT_MAX
from s2r_runtime.messages import (
    LinkChanged,
    Observed,
    Send,
    Stopping,
)
from s2r_runtime.modelspec import EffectSpec, dump_model, load_model
from s2r_runtime.profile import load_profile
from s2r_runtime.recording.reading import read


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def realtime(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path, clock="realtime")
    yield opened
    opened.close()


# ---------------------------------------------------------------- start and end


def test_daemon_serves_ends_on_sigterm_with_the_recovery_command_and_leaves_a_closed_log(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    status = rig.status()
    assert (status["gate"], status["reason"], status["link"]) == ("closed", "no_controller", True)
    assert {"controller", "certificate", "radius", "verified_radius", "e_value", "epoch", "beta_spent", "beta_left"} <= set(status)
    assert rig.stop() == 0
    assert not rig.socket.exists()
    (log,) = rig.log_files()
    reading = read(log)
    last = list(reading)[-1]
    assert reading.ending is not None
    assert reading.ending.kind == "closed"
    assert f"log {log} ends at " in rig.said()
    assert isinstance(rig.messages("event/stopping")[-1], Stopping)
    assert last.channel.startswith("out/")
    assert rig.applied()[-1]["source"] == "recovery"
    assert rig.applied()[-1]["u"] == [0.0, 0.0]


@pytest.mark.slow
def test_key_is_made_once_for_its_owner_alone(rig: Rig) -> None:
    rig.start()
    rig.stop()
    key = rig.state / "key.pem"
    before = key.read_bytes()
    assert key.stat().st_mode & 0o777 == 0o600
    assert "made a signing key" in rig.said()
    rig.start()
    rig.stop()
    assert key.read_bytes() == before


def test_second_daemon_of_a_robot_is_refused(rig: Rig) -> None:
    rig.start()
    code, said = rig.refused()
    assert code == 78
    assert "another process uses the state of robot 'rig'" in said
    assert rig.status()["gate"] == "closed"


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ('name = "unicycle"', 'name = "unicicle"', "did you mean 'unicycle'?"),
        ('name = "grid_world"', 'name = "grid_wold"', "did you mean 'grid_world'?"),
        ('name = "loop"', 'name = "robotarium"', "install the package s2r-standins"),
        ("x = [-1.6, 1.6]", "z = [-1.6, 1.6]", "region.z"),
    ],
)
def test_profile_that_names_what_is_not_there_is_one_clear_line(rig: Rig, old: str, new: str, names: str) -> None:
    rig.profile.write_text(rig.profile.read_text().replace(old, new))
    code, said = rig.refused()
    assert code == 78
    assert names in said
    assert len([line for line in said.splitlines() if "made a signing key" not in line]) == 1
    assert not list(rig.logs.glob("*.mcap"))


def test_service_manager_hears_ready_alive_and_stopping(rig: Rig) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(rig.folder / "notify"))
        manager.settimeout(30.0)
        rig.start(environment={"NOTIFY_SOCKET": str(rig.folder / "notify"), "WATCHDOG_USEC": "200000"})
        said = [manager.recv(1000).decode() for _ in range(4)]
        assert rig.stop() == 0
        manager.settimeout(1.0)
        while said[-1] != "STOPPING=1":
            said.append(manager.recv(1000).decode())
    assert said[0].startswith("READY=1")
    assert said.count("WATCHDOG=1") >= 1


def test_robot_that_never_answers_leaves_the_gate_closed_and_sampling_refused(rig: Rig) -> None:
    rig.start()
    rig.ask("permit", duration_s=60.0)
    answer = rig.ask("sample")
    assert answer["exit_code"] == 1
    assert "link_down" in answer["text"]
    assert rig.status()["beta_spent"] == 0.0


def test_defect_in_the_core_ends_with_the_recovery_command_and_exit_70(rig: Rig) -> None:
    rig.start_robot()
    rig.start("--break-at", "20")
    assert rig.daemon is not None
    assert rig.daemon.wait(30.0) == 70
    assert "ZeroDivisionError: a defect" in rig.said()
    last = rig.applied()[-1]
    assert (last["source"], last["u"], last["obs_seq"]) == ("recovery", [0.0, 0.0], 20)
    reading = read(rig.log_files()[-1])
    assert list(reading)[-1].channel == "frame/out"
    assert reading.ending is not None
    assert reading.ending.kind == "closed"


# ---------------------------------------------------------------- requests


@pytest.mark.slow
def test_requests_that_make_no_sense_are_answered_with_their_code(rig: Rig) -> None:
    rig.start()
    for request, code, words in (
        ({"verb": "dance"}, 2, "no such request"),
        ({"verb": "permit", "duration_s": "long"}, 2, "duration_s"),
        ({"verb": "permit", "duration_s": -1.0}, 78, "must be >= 0"),
        ({"verb": "permit", "colour": "red"}, 2, "colour"),
        ({"verb": "deploy", "path": str(rig.folder / "none.py")}, 78, "none.py"),
        ({"verb": "deploy", "path": "/dev/zero"}, 78, "/dev/zero"),
        ({"verb": "adopt", "text": "model = 3"}, 78, "adopt"),
        ({"verb": "adopt", "text": "[model]\nname = 'bicycle'\ndt = 0.033"}, 78, "adopt"),
        ({"verb": "adopt", "text": "[model]\nname = 'unicycle'\ndt = 0.1"}, 78, "dt is 0.1 s"),
        ({"verb": "clear", "text": "nothing"}, 2, "not latched"),
        ({"verb": "trace"}, 3, "sample first"),
    ):
        answer = rig.ask(**request)
        assert (answer["exit_code"], words in answer["text"]) == (code, True), (request, answer)


@pytest.mark.slow
def test_stop_latches_until_it_is_cleared(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    assert rig.ask("stop")["exit_code"] == 0
    assert rig.status()["latched"] == ["emergency_stop"]
    rig.kill()
    rig.start()
    assert rig.status()["latched"] == ["emergency_stop"]
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=60.0)
    assert "emergency_stop" in rig.ask("sample")["text"]
    assert rig.ask("clear", text="emergency_stop")["exit_code"] == 0
    assert rig.sample()["exit_code"] == 0


def test_a_model_of_twenty_fits_is_adopted_without_holding_up_the_loop(rig: Rig) -> None:
    """Each fit saw more rows than a sketch holds."""
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    fits = [sketch([np.random.default_rng(seed).uniform(-1, 1, (20_000, 3))], (2,)) for seed in range(20)]
    fitted = msgspec.structs.replace(load_profile(rig.profile).model, fitted_on=united(*fits))
    spec = msgspec.structs.replace(fitted, effects=(EffectSpec("input_gain", "v", {"gain": 0.9}),))
    model = rig.folder / "twenty.toml"
    model.write_text(dump_model(spec))
    assert model.stat().st_size > 20 * 130_000
    answer = rig.s2r("adopt", str(model), "--socket", str(rig.socket))
    assert answer.returncode == 0, answer.stderr
    assert rig.status()["model"] == spec.digest()
    (kept,) = (rig.state / "models").glob("*.toml")
    assert load_model(kept).fitted_on == spec.fitted_on


def test_the_longest_request_is_scanned_in_a_fraction_of_what_the_loop_may_be_held() -> None:
    line = json.dumps({"verb": "adopt", "text": "x" * TEXT_MAX}).encode()
    assert len(line) < control.REQUEST_MAX
    times = []
    for _ in range(5):
        begun = time.thread_time()
        door.decode_request(line)
        times.append(time.thread_time() - begun)
    assert min(times) < 0.01


@pytest.mark.slow
def test_adopted_model_is_in_force_after_a_restart_and_the_profiles_own_change_ends_that(rig: Rig) -> None:
    rig.start()
    profiles = rig.status()["model"]
    repaired = "[model]\nname = 'unicycle'\ndt = 0.033\n[[model.effects]]\nname = 'input_gain'\nchannel = 'w'\nparameters = {gain = 0.7}\n"
    assert rig.ask("adopt", text=repaired.replace("gain =", "gian ="))["exit_code"] == 78
    assert rig.ask("adopt", text=repaired)["exit_code"] == 0
    adopted = rig.status()["model"]
    assert adopted != profiles
    rig.kill()
    rig.start()
    assert rig.status()["model"] == adopted
    rig.stop()
    rig.profile.write_text(rig.profile.read_text().replace("delay = 0.033", "delay = 0.066"))
    rig.start()
    assert rig.status()["model"] not in (adopted, profiles)


# ---------------------------------------------------------------- the robot's side


def test_transport_that_raises_is_a_lost_link_until_it_works_again(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.to_daemon(**{"raise": "a defect of the plug-in"})
    rig.until(lambda: len(rig.messages("event/link_changed")) >= 3)
    details = [(m.up, m.detail) for m in rig.messages("event/link_changed") if isinstance(m, LinkChanged)]
    assert details[1] == (False, "transport: decode raised RuntimeError: a defect of the plug-in")
    assert details[2][0]
    rig.until_status(link=True)


def test_robots_own_stop_button_latches(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.to_daemon(estop=True)
    rig.until_status(latched=["emergency_stop"])


@pytest.mark.slow
def test_bytes_that_are_no_observation_do_nothing_but_count(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        for data in (b"", b"\xff\x00", b"{}", b'{"seq": 1, "stamp_ns": 0, "x": [1, 2]}', b'{"seq": 2, "stamp_ns": 0, "x": [NaN, 0, 0]}'):
            sock.sendto(data, str(rig.folder / "daemon.sock"))
    rig.until(lambda: rig.status()["counters"]["malformed"] >= 3)
    rig.ask("permit", duration_s=3600.0)
    rig.until(lambda: rig.ask("sample")["exit_code"] == 0)  # refused until the robot has repeated what it measured


def test_in_real_time_every_observation_gets_its_recovery_command(realtime: Rig) -> None:
    realtime.start_robot()
    realtime.start()
    realtime.until(lambda: realtime.status()["counters"]["sent"] > 30)
    realtime.stop()
    observed = [m.observation.seq for m in realtime.messages("event/observed") if isinstance(m, Observed)]
    answered = {m.obs_seq for m in realtime.messages("out/send") if isinstance(m, Send)}
    assert set(observed[1:-1]) <= answered


def test_process_needs_no_numpy(tmp_path: Path) -> None:
    program = "import sys, s2r_runtime.daemon.loop, s2r_runtime.daemon.campaign_run; sys.exit(bool({'numpy', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=dict(os.environ), check=False).returncode == 0
