"""The daemon with the built-in robot over real Zenoh on loopback: robots that freeze, die and lose messages, and uninvited commands."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from zenoh_rig import ZenohRig

from s2r_runtime.messages import Decided, LinkChanged, Proposed, Send

pytest.importorskip("s2r_zenoh")
pytest.importorskip("s2r_standins")

from s2r_zenoh.testing import session


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[ZenohRig]:
    opened = ZenohRig(tmp_path)
    yield opened
    opened.close()


def test_campaign_drive_and_audit_over_zenoh(rig: ZenohRig) -> None:
    """beta bounds the chance that the gap does not hold. Then the watch rightly refutes it, and no scenario comes to its end."""
    text = rig.profile.read_text()
    assert "beta = 0.5" in text
    rig.profile.write_text(text.replace("beta = 0.5", "beta = 0.002"))
    rig.start()
    rig.start_robot()
    assert rig.sample()["exit_code"] == 0
    good = Path(__file__).parent.parent / "controllers" / "grid.py"
    answer = rig.ask("deploy", path=str(good))
    assert answer["exit_code"] == 0, answer
    rig.until(lambda: rig.status()["scenarios"] >= 1)
    assert rig.stop() == 0
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--rerun-controllers", "--json").stdout)
    assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found
    assert [certificate["valid"] for certificate in found["certificates"]]


def test_campaign_outlives_a_robot_that_freezes_dies_and_loses_messages(rig: ZenohRig) -> None:
    rig.start()
    rig.start_robot("--lose-commands", "0.02", "--lose-observations", "0.02")
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    campaign = subprocess.Popen(
        [sys.executable, "-m", "s2r_runtime.cli.main", "sample", str(rig.profile), "--socket", str(rig.socket), "--json"],
        stdout=subprocess.PIPE,
        env=rig.environment,
    )
    assert rig.robot is not None
    rig.until(lambda: (rig.status()["campaign"] or {}).get("taken", 0) >= 1)
    rig.robot.send_signal(signal.SIGSTOP)
    rig.until_status(link=False)
    rig.robot.send_signal(signal.SIGCONT)
    rig.until_status(link=True)
    rig.robot.kill()
    rig.robot.wait()
    rig.until_status(link=False)
    rig.start_robot()
    out, _ = campaign.communicate(timeout=60.0)
    answer = json.loads(out)
    assert answer["exit_code"] == 0, answer
    assert answer["data"]["n"] >= 8
    assert [m.up for m in rig.messages("event/link_changed") if isinstance(m, LinkChanged)].count(False) >= 2


@pytest.mark.slow
def test_given_inputs_reach_the_robot_over_zenoh_row_by_row(rig: ZenohRig) -> None:
    rig.start()
    rig.start_robot()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    path = rig.folder / "inputs.csv"
    rows = [(0.05, (-1.0) ** (k // 20)) for k in range(100)]
    path.write_text("t,v,w\n" + "".join(f"{0.033 * k:.9g},{v},{w}\n" for k, (v, w) in enumerate(rows)))
    done = rig.s2r("sample", str(rig.profile), "--inputs", str(path))
    assert (done.returncode, "100 rows driven" in done.stdout) == (0, True), done.stderr
    assert rig.stop() == 0
    assert [m.u for m in rig.messages("out/send") if isinstance(m, Send) and m.source == "sampler"] == rows
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (found["ok"], found["recomputed"]["commands of given inputs"]) == (True, 100), found


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_a_suggested_drive_is_driven_and_tells_apart_what_the_first_one_could_not(rig: ZenohRig) -> None:
    """The loop of docs/operating.md: drive something, trace it, drive what the tracer suggests, trace that."""
    rig.start()
    rig.start_robot("--effect", "input_gain:w gain=0.7")
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    first, suggested = rig.folder / "first.csv", rig.folder / "next.csv"
    first.write_text("t,v,w\n" + "".join(f"{0.033 * k:.9g},0.05,{(-1.0) ** (k // 20)}\n" for k in range(160)))
    done = rig.s2r("sample", str(rig.profile), "--inputs", str(first))
    assert (done.returncode, "160 rows driven" in done.stdout) == (0, True), done.stderr
    before = rig.ask("trace", text="inputs")["data"]
    assert before["verdict"] == "ambiguous", before["text"]
    done = rig.s2r("trace", rig.status()["log"], "--profile", str(rig.profile), "--suggest", str(suggested))
    assert done.returncode == 0, done.stderr
    done = rig.s2r("sample", str(rig.profile), "--inputs", str(suggested))
    assert done.returncode == 0, done.stderr
    after = rig.ask("trace", text="inputs")["data"]
    told_apart = {e["name"] for e in before["ambiguous_with"]} - {e["name"] for e in after["ambiguous_with"]}
    assert after["effects"][0]["name"] == "input_gain"
    assert after["effects"][0]["channel"] == "w"
    assert "input_saturation" in told_apart, (before["text"], after["text"])
    assert rig.stop() == 0
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert found["ok"], found
    assert found["recomputed"]["traces run again"] == 2
    assert found["recomputed"]["commands of given inputs"] == 160 + len(suggested.read_text().splitlines()) - 1


@pytest.mark.slow
def test_uninvited_commands_are_logged_and_never_obeyed(rig: ZenohRig) -> None:
    rig.start()
    rig.start_robot()
    rig.until(lambda: rig.status()["observation"])
    with session("client", connect=rig.outside) as outsider:
        data = json.dumps({"input": {"v": 0.2, "w": 0.0}, "seq": 1, "obs_seq": 1})
        rig.until(lambda: outsider.put("s2r/robot/proposal", data) or rig.status()["counters"]["proposals"] > 0)
    rig.stop()
    uninvited = [m.command for m in rig.messages("event/proposed") if isinstance(m, Proposed)]
    assert {command.source for command in uninvited} == {"external"}
    decided = [m for m in rig.messages("out/decided") if isinstance(m, Decided)]
    assert [(m.allow, m.reason) for m in decided] == [(False, "source_not_allowed")] * len(uninvited)
    assert {m.source for m in rig.messages("out/send") if isinstance(m, Send)} == {"recovery"}
