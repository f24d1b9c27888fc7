"""The daemon while a controller drives: what it takes to drive, what ends it, and that the log shows it all again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_rig import Rig, made_up_certificate

from s2r_runtime.messages import AnalyticsChanged, Decided, GateChanged, Measured, Revoked, Send, SourceStopped
from s2r_runtime.trust import keys


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


def driving(rig: Rig, body: str = "    return np.tile([0.0, 0.5], (len(x), 1))\n") -> None:
    """A daemon on which this controller drives."""
    rig.start_robot()
    rig.start()
    answer = rig.deploy(rig.controller(body))
    assert answer["exit_code"] == 0, answer
    rig.until_status(gate="open", driving="controller")


def gone(pid: int) -> bool:
    """Whether that process has ended (a zombie has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_certified_controller_drives_and_nothing_else_reaches_the_robot(rig: Rig) -> None:
    driving(rig)
    rig.until(lambda: rig.status()["observation"]["seq"] > 300)
    assert rig.ask("undeploy")["exit_code"] == 0
    rig.until_status(driving="recovery", reason="no_controller")
    rig.stop()
    applied = rig.applied()
    assert {command["source"] for command in applied} == {"controller", "recovery"}
    assert all(command["u"] == [0.0, 0.5] for command in applied if command["source"] == "controller")
    assert all(command["u"] == [0.0, 0.0] for command in applied if command["source"] == "recovery")
    allowed = {m.obs_seq for m in rig.messages("out/decided") if isinstance(m, Decided) and m.allow}
    assert {command["obs_seq"] for command in applied if command["source"] == "controller"} <= allowed
    opened = [m.open for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged)]
    assert opened.count(True) == 1


def test_audit_of_a_drive_holds_and_notices_one_changed_bit(rig: Rig) -> None:
    driving(rig)
    rig.until(lambda: rig.status()["observation"]["seq"] > 200)
    rig.kill()
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (found["ok"], found["first_difference"]) == (True, None), found
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(data)
    assert rig.s2r("audit", str(log), "--json").returncode == 1


def test_controller_without_a_certificate_and_without_a_gap_is_refused(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    answer = rig.ask("deploy", path=str(rig.controller()))
    assert (answer["exit_code"], "there is no gap yet" in answer["text"]) == (1, True)
    assert rig.status()["attempts"] == 0


@pytest.mark.slow
def test_certificate_with_one_bit_changed_is_refused_and_nothing_is_spent(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    controller = rig.controller()
    good = rig.certificate(controller)
    at = good.index('"radius":') + len('"radius":') + 2
    changed = good[:at] + chr(ord(good[at]) ^ 1) + good[at + 1 :]
    answer = rig.ask("deploy", path=str(controller), certificate=changed)
    assert (answer["exit_code"], "was changed after it was signed" in answer["text"]) == (78, True), answer
    other = rig.controller("    return np.tile([0.0, 0.4], (len(x), 1))\n", "other.py")
    answer = rig.ask("deploy", path=str(other), certificate=good)
    assert (answer["exit_code"], "is of the controller" in answer["text"]) == (78, True), answer
    status = rig.status()
    assert (status["controller"], status["certificate"], status["attempts"], status["epoch"]) == (None, None, 0, 0)
    assert {command["source"] for command in rig.applied()} == {"recovery"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("    if x[0, 2] > 0.3:\n        raise ValueError('too far')\n    return np.tile([0.0, 0.5], (len(x), 1))\n", "raised"),
        ("    if x[0, 2] > 0.3:\n        time.sleep(60)\n    return np.tile([0.0, 0.5], (len(x), 1))\n", "deadline"),
        ("    return np.tile([0.0, 0.5 if x[0, 2] < 0.3 else np.nan], (len(x), 1))\n", "malformed"),
        ("    return np.tile([0.0, 0.5] if x[0, 2] < 0.3 else [0.0], (len(x), 1))\n", "malformed"),
        ("    if x[0, 2] > 0.3:\n        import os\n        os._exit(3)\n    return np.tile([0.0, 0.5], (len(x), 1))\n", "died"),
    ],
    ids=["raises", "hangs", "nan", "wrong shape", "exits"],
)
def test_controller_that_fails_stops_the_robot_and_stays_out_until_a_person_clears_it(rig: Rig, body: str, reason: str) -> None:
    rig.start_robot()
    rig.start()
    assert rig.deploy(rig.controller(body))["exit_code"] == 0
    rig.until_status(latched=["controller_fault"], driving="recovery")
    assert [m.open for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged)].count(True) == 1  # it drove, and failed then
    stopped = [m for m in rig.messages("event/source_stopped") if isinstance(m, SourceStopped) and m.source == "controller"]
    assert [m.reason for m in stopped] == [reason]
    assert rig.applied()[-1]["source"] == "recovery"
    rig.deploy(rig.controller())
    assert rig.status()["gate"] == "closed"
    assert rig.ask("clear", text="controller_fault")["exit_code"] == 0
    rig.until_status(gate="open")


def test_killed_controller_is_replaced_by_the_recovery_command(rig: Rig) -> None:
    driving(rig)
    os.kill(rig.status()["pids"]["controller"], signal.SIGKILL)
    rig.until_status(latched=["controller_fault"], gate="closed", driving="recovery")
    detail = next(m.detail for m in rig.messages("event/source_stopped") if isinstance(m, SourceStopped))
    assert "killed by SIGKILL" in detail or "closed its socket" in detail  # on a busy machine the daemon doesn't wait to learn more


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["dead", "frozen"])
def test_nobody_drives_unwatched(tmp_path: Path, how: signal.Signals) -> None:
    rig = Rig(tmp_path, more="[machine]\nprocess_timeout = 3.0")
    try:
        _nobody_drives_unwatched(rig, how)
    finally:
        rig.close()


def _nobody_drives_unwatched(rig: Rig, how: signal.Signals) -> None:
    driving(rig)
    pid = rig.status()["pids"]["analytics"]
    os.kill(pid, how)
    rig.until(lambda: rig.status()["pids"]["analytics"] not in (0, pid))
    rig.until_status(gate="open", analytics="up")
    assert gone(pid)
    up = [m.up for m in rig.messages("event/analytics_changed") if isinstance(m, AnalyticsChanged)]
    assert up == [False, True]
    reasons = [m.reason for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged)]
    assert "analytics_down" in reasons
    measured = [m.n for m in rig.messages("event/measured") if isinstance(m, Measured)]
    assert measured == sorted(measured)  # the watch went on where it was


def test_robot_that_is_not_the_models_loses_its_certificate(rig: Rig) -> None:
    rig.start_robot("--gain", "0.5")
    rig.start()
    turning = rig.controller("    return np.tile([0.0, 2.5], (len(x), 1))\n")  # the robot turns 0.04 rad, 0.002 in the norm, less a period
    rig.until(lambda: rig.status()["observation"])
    narrow = rig.certificate(turning, radius=0.001, verified=0.0015)
    assert rig.ask("deploy", path=str(turning), certificate=narrow)["exit_code"] == 0
    status = rig.until(lambda: (found := rig.status())["revoked"] and found)
    assert (status["gate"], status["driving"]) == ("closed", "recovery")
    assert status["radius"] > 0.0015
    assert [m.certificate_id for m in rig.messages("out/revoked") if isinstance(m, Revoked)] == list(status["revoked"])
    rig.until(lambda: rig.status()["controller"] is None)


def test_stop_stops_a_driving_controller_at_once(rig: Rig) -> None:
    driving(rig)
    rig.ask("stop")
    status = rig.until_status(driving="recovery", controller=None)
    assert status["latched"] == ["emergency_stop"]
    assert rig.ask("deploy", path=str(rig.controller()))["exit_code"] == 1


def test_killed_daemon_takes_its_processes_along_and_nothing_drives_after_the_restart(rig: Rig) -> None:
    driving(rig)
    pids = rig.status()["pids"]
    rig.kill()
    rig.until(lambda: gone(pids["controller"]) and gone(pids["analytics"]))
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    status = rig.status()
    assert (status["gate"], status["controller"], status["epoch"]) == ("closed", None, 1)
    assert rig.ask("deploy", path=str(rig.controller()))["exit_code"] == 0  # its certificate is still in force
    assert rig.status()["attempts"] == 1
    assert rig.ask("revoke")["exit_code"] == 0
    rig.until_status(gate="closed", controller=None, driving="recovery")


@pytest.mark.slow
def test_verification_of_a_real_gap_decides_who_drives(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    assert rig.sample()["exit_code"] == 0
    standing = rig.ask("deploy", path=str(rig.controller("    return np.zeros((len(x), 2))\n", "standing.py")))
    assert (standing["exit_code"], "progress" in standing["text"]) == (1, True), standing
    reckless = rig.ask("deploy", path=str(rig.controller("    return np.tile([0.2, 0.0], (len(x), 1))\n", "reckless.py")))
    assert reckless["exit_code"] == 1, reckless
    assert not reckless["data"]["passed"]
    good = rig.ask("deploy", path=str(Path(__file__).parent.parent / "controllers" / "grid.py"))
    assert good["exit_code"] == 0, good
    assert rig.status()["attempts"] == 3
    rig.until(lambda: rig.status()["scenarios"] >= 1)
    assert list((rig.state / "certificates").glob("*.json"))
    assert {m.source for m in rig.messages("out/send") if isinstance(m, Send)} == {"recovery", "sampler", "controller"}


def test_certificate_signed_elsewhere_counts_only_if_its_key_is_trusted(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    controller, office = rig.controller(), rig.folder / "office.pem"
    keys.new(office)
    made = made_up_certificate(rig.profile, office, controller, radius=0.01, verified=0.02, epoch=1)
    refused = rig.ask("deploy", path=str(controller), certificate=made)
    assert (refused["exit_code"], "not trusted here" in refused["text"]) == (78, True), refused
    for remedy in (f"{rig.state / 'trusted'}/", "s2r run --key FILE", f"s2r certify --key {rig.state / 'key.pem'}"):
        assert remedy in refused["text"]
    (rig.state / "trusted").mkdir()
    shutil.copy(keys.public_path(office), rig.state / "trusted" / "office.pub")
    accepted = rig.ask("deploy", path=str(controller), certificate=made)
    assert accepted["exit_code"] == 0, accepted
    rig.until_status(gate="open")


@pytest.mark.slow
def test_effect_that_was_traced_and_adopted_makes_a_smaller_gap_and_its_own_samples_never_bound_it(rig: Rig) -> None:
    rig.start_robot("--gain", "0.7")
    rig.start()
    before = rig.sample()
    trace = rig.ask("trace")
    assert trace["exit_code"] == 0, trace
    (effect,) = trace["data"]["effects"]
    assert (effect["name"], effect["channel"]) == ("input_gain", "w")
    gain = effect["parameters"]["gain"]
    assert gain["low"] <= 0.7 <= gain["high"]
    model = Path(trace["data"]["model_path"])
    assert rig.ask("adopt", text=model.read_text(), base=str(model.parent))["exit_code"] == 0
    status = rig.status()
    assert (status["radius"], status["epoch"]) == (None, 1)
    after = rig.sample()
    assert (after["exit_code"], after["data"]["epoch"]) == (0, 2), after
    assert after["data"]["hold_radius"] < 0.5 * before["data"]["hold_radius"]
    rig.stop()
    own = rig.s2r("gap", str(rig.log_files()[0]), "--profile", str(rig.profile), "--model", str(model), "--epsilon", "0.3")
    assert own.returncode == 0, own.stderr  # its last campaign is the fresh one


def test_in_real_time_a_controller_drives_at_the_robots_pace(tmp_path: Path) -> None:
    rig = Rig(tmp_path, clock="realtime")
    try:
        driving(rig)
        rig.until(lambda: rig.status()["measured"] >= 20)
        begin, seq = time.monotonic(), rig.status()["observation"]["seq"]
        rig.until(lambda: rig.status()["observation"]["seq"] >= seq + 30)
        assert time.monotonic() - begin > 0.9
        rig.stop()
    finally:
        rig.close()
