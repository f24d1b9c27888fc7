"""The tracer in the loop of the daemon: what it is made on, when it runs, who adopts what it proposes, and that it holds up nobody."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime.daemon.trace_job import NICE
from s2r_runtime.messages import InputsFinished, JobFinished, ModelAdopted, SampleTaken, StartJob, TraceEnded
from s2r_runtime.modelspec import load_model

WEAVING = """    k = np.abs(x[:, 2] * 1e6).astype(int)
    return np.stack([0.0 * x[:, 0], np.array([0.8, 2.4, 1.6, 0.4, -0.8, -2.4, -1.6, -0.4])[k % 8]], axis=1)
"""
"""Turns to and fro on the spot at rates that the last digits of the heading choose: enough to see what a turn is worth."""

TWITCHING = """    k = np.abs(x[:, 2] * 1e6).astype(int)
    return np.stack([0.0 * x[:, 0], np.array([0.8, 1.6, 0.4, 1.2, 0.4, 1.2, 2.4])[k % 7] * np.array([1, -1])[k // 7 % 2]], axis=1)
"""
"""As fast as 2.4 rad/s for a seventh of the time: that makes the gap grow, and no alarm at epsilon 0.3."""


def opened(folder: Path, more: str = "", *robot: str) -> Rig:
    rig = Rig(folder, more=more)
    rig.start_robot(*robot)
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    return rig


@pytest.fixture
def rigs(tmp_path: Path) -> Iterator[Any]:
    made: list[Rig] = []

    def make(more: str = "", *robot: str) -> Rig:
        made.append(opened(tmp_path, more, *robot))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def traces(rig: Rig) -> list[JobFinished]:
    return [m for m in rig.messages("event/job_finished") if isinstance(m, JobFinished) and m.kind == "trace"]


def inputs_file(rig: Rig, rows: int = 200, *, v: float = 0.0, w: float = 2.0, name: str = "inputs.csv") -> Path:
    """Turns to and fro on the spot, with steps of several sizes."""
    path = rig.folder / name
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t", "v", "w"])
        for k in range(rows):
            table.writerow([f"{0.033 * k:.6f}", v, w * math.sin(0.05 * k) * (-1) ** (k // 40)])
    return path


def sample_inputs(rig: Rig, path: Path) -> tuple[int, dict[str, Any]]:
    done = rig.s2r("sample", str(rig.profile), "--inputs", str(path), "--json")
    return done.returncode, json.loads(done.stdout or "{}")


# ---------------------------------------------------------------- the stream


@pytest.mark.slow
def test_a_drive_is_traced_on_demand_and_the_log_says_on_which_rows(rigs: Any) -> None:
    rig = rigs("", "--gain", "0.7")
    nothing = rig.ask("trace", text="drive")
    assert (nothing["exit_code"], "no controller has driven" in nothing["text"]) == (3, True)
    assert rig.deploy(rig.controller(WEAVING))["exit_code"] == 0
    rig.until(lambda: rig.status()["observation"]["seq"] > 400)
    answer = rig.ask("trace", text="drive")
    assert answer["exit_code"] == 0, answer
    found = answer["data"]
    assert (found["verdict"], [e["name"] for e in found["effects"]]) == ("traced", ["input_gain"]), found["text"]
    assert rig.status()["gate"] == "open", "it drove on"
    recording = found["recording"]
    assert (recording["stretch"], recording["epoch"]) == ("drive", 1)
    assert recording["observations"] > 350
    assert recording["digest"].startswith("sha256:")
    assert [part["run"] for part in recording["parts"]] == [rig.log_files()[-1].stem]
    assert (found["model"], found["seed"], found["options"]["rows"]) == (rig.status()["model"], 0, 40_000)
    (order,) = [m for m in rig.messages("out/start_job") if isinstance(m, StartJob)]
    assert (order.stretch, order.digest) == ("drive", found["model"])
    status = rig.status()
    assert status["proposal"]["digest"] == found["proposal"]["digest"]
    assert Path(status["proposal"]["path"]) == Path(found["model_path"])
    assert load_model(Path(found["model_path"])).digest() == found["proposal"]["digest"]
    assert status["trace"]["verdict"] == "traced"
    driving = rig.ask("adopt")
    assert (driving["exit_code"], "while nothing drives" in driving["text"]) == (1, True)
    rig.ask("undeploy")
    assert rig.ask("adopt")["exit_code"] == 0
    status = rig.status()
    assert (status["model"], status["radius"], status["proposal"]) == (found["proposal"]["digest"], None, None)
    rig.stop()
    (adopted,) = [m for m in rig.messages("out/model_adopted") if isinstance(m, ModelAdopted)]
    assert (adopted.digest, adopted.by, adopted.proposed) == (status["model"], os.getuid(), True)
    (log,), profile = rig.log_files(), str(rig.profile)
    blocked = ("gap", str(log), "--profile", profile, "--epsilon", "0.3", "--blocking", "0.2")
    assert rig.s2r(*blocked).returncode == 0
    fitted = rig.s2r(*blocked, "--model", found["model_path"])
    assert (fitted.returncode, "was fitted on this recording" in fitted.stderr) == (3, True), fitted.stderr
    audited = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (audited["ok"], audited["recomputed"]["traces run again"]) == (True, 1), audited
    assert "the one that trace" in audited["models"][0]["origin"]
    page = rig.folder / "report.html"
    assert rig.s2r("report", str(log), "-o", str(page)).returncode == 0
    text = page.read_text(encoding="utf-8")
    assert "Made on the drive of epoch 1" in text
    assert f"It proposes the repaired model {status['model'][7:19]}" in text
    assert "the proposed model adopted by user" in text


@pytest.mark.slow
def test_given_inputs_are_driven_recorded_and_traced(rigs: Any) -> None:
    rig = rigs("[repair]\nafter_inputs = true\n", "--gain", "0.7")
    path = inputs_file(rig, 250)
    code, refused = sample_inputs(rig, path)
    assert (code, "no_permit" in refused["text"]) == (1, True)
    rig.ask("permit", duration_s=3600.0)
    code, answer = sample_inputs(rig, path)
    assert code == 0, answer
    assert "no independent samples" in answer["text"]
    assert answer["data"]["independent"] is False
    assert answer["data"]["statement"].startswith("No statement")
    rows = [[float(v), float(w)] for _, v, w in list(csv.reader(path.read_text().splitlines()))[1:]]
    driven = [command["u"] for command in rig.applied() if command["source"] == "sampler"]
    assert driven == rows
    status = rig.until(lambda: (found := rig.status())["trace"] and found)
    assert (status["trace"]["stretch"], status["trace"]["verdict"]) == ("inputs", "traced")
    assert (status["epoch"], status["radius"]) == (0, None), "no epoch was begun, no gap found"
    assert not [m for m in rig.messages("event/sample_taken") if isinstance(m, SampleTaken)]
    (finished,) = [m for m in rig.messages("event/inputs_finished") if isinstance(m, InputsFinished)]
    assert (finished.n, finished.complete) == (250, True)
    (one,) = traces(rig)
    assert one.trace is not None
    assert one.trace["recording"]["observations"] >= 250  # type: ignore[index]
    rig.stop()
    (log,) = rig.log_files()
    audited = json.loads(rig.s2r("audit", str(log), "--json").stdout)
    assert (audited["ok"], audited["recomputed"]["traces run again"], audited["recomputed"]["commands of given inputs"]) == (True, 1, 250)
    gap = rig.s2r("gap", str(log), "--profile", str(rig.profile), "--json")
    assert (gap.returncode, json.loads(gap.stdout)["independent"]) == (3, False), "it bounds nothing"


@pytest.mark.slow
def test_inputs_stop_with_everything_that_stops_the_sampler_and_never_leave_their_bounds(rigs: Any) -> None:
    rig = rigs("[geofence]\nx = [-0.5, 0.5]\ny = [-0.5, 0.5]\n")
    rig.ask("permit", duration_s=3600.0)
    outside = sample_inputs(rig, inputs_file(rig, 50, w=4.0, name="outside.csv"))
    assert (outside[0], "line" in outside[1]["text"], "must be within its bounds -3.1 to 3.1" in outside[1]["text"]) == (1, True, True)
    away = sample_inputs(rig, inputs_file(rig, 200, v=0.2, w=0.0, name="away.csv"))
    assert (away[0], "would take the robot out of the geofence" in away[1]["text"]) == (1, True), away
    assert rig.status()["inputs"] is None
    assert {command["source"] for command in rig.applied()} <= {"recovery"}
    long = inputs_file(rig, 6000, name="long.csv")
    rig.ask("permit", duration_s=5.0)  # of the robot's time
    code, expired = sample_inputs(rig, long)
    assert (code, "permit_expired" in expired["text"]) == (1, True)
    assert rig.applied()[-1]["source"] == "recovery"
    for end in ("stop", "cancel"):
        rig.ask("permit", duration_s=3600.0)
        waiting = rig.background("excite", path=str(long))
        rig.until(lambda: (rig.status()["inputs"] or {}).get("driven", 0) > 5)
        busy = rig.ask("excite", path=str(long))
        assert (busy["exit_code"], "inputs are being driven already" in busy["text"]) == (2, True)
        assert rig.ask(end)["exit_code"] == 0
        answer = waiting()
        assert (answer["exit_code"], answer["data"]["complete"]) == (1, False), answer
        rig.until_status(inputs=None, driving="recovery")
        rig.ask("clear", text="emergency_stop")
    rig.stop()
    ended = [m for m in rig.messages("event/inputs_finished") if isinstance(m, InputsFinished)]
    assert [m.complete for m in ended] == [False, False, False]


# ---------------------------------------------------------------- when the gap grows


@pytest.mark.slow
def test_a_gap_that_grows_while_a_controller_drives_is_traced(rigs: Any) -> None:
    rig = rigs("[repair]\non_growth = true\ndelay = 12.0\n", "--gain", "0.7")
    controller = rig.controller(TWITCHING)
    wide = rig.certificate(controller, radius=1.05e-3, verified=1.0)
    assert rig.ask("deploy", path=str(controller), certificate=wide)["exit_code"] == 0
    status = rig.until(lambda: (found := rig.status())["trace"] and found)
    assert status["trace"]["stretch"] == "drive"
    assert status["trace"]["verdict"] in {"traced", "ambiguous"}, status["trace"]
    rig.stop()
    grown = [m.t_ns for m in rig.messages("out/radius_grew")]  # type: ignore[attr-defined]
    begun = [m.t_ns for m in rig.messages("out/start_job") if isinstance(m, StartJob)]
    assert begun[0] - grown[0] >= 12e9, "there is something to see by then"
    assert next(m.verdict for m in rig.messages("out/trace_ended") if isinstance(m, TraceEnded)) == status["trace"]["verdict"]


# ---------------------------------------------------------------- nobody waits for it


@pytest.mark.slow
def test_a_trace_steps_back_and_stands_still_while_somebody_waits_for_other_work(rigs: Any) -> None:
    rig = rigs("", "--gain", "0.7")
    assert rig.sample()["exit_code"] == 0
    waiting = rig.background("trace")
    worker = rig.until(lambda: rig.children("s2r_runtime.daemon.worker"))[0]
    rig.until(lambda: nice(worker) == min(19, os.nice(0) + NICE))
    answer = rig.background("deploy", path=str(Path(__file__).parent.parent / "controllers" / "grid.py"))
    rig.until(lambda: state(worker) == "T")
    assert len(rig.children("s2r_runtime.daemon.worker")) == 2
    answer()
    assert waiting()["data"]["verdict"] == "traced", "it went on where it stood"


def test_a_trace_that_takes_too_long_is_ended_and_the_log_says_so(rigs: Any) -> None:
    rig = rigs("[repair]\ntimeout = 0.3\n")
    assert rig.sample()["exit_code"] == 0
    answer = rig.ask("trace")
    assert (answer["exit_code"], "not done within 0.3 s (repair.timeout)" in answer["text"]) == (1, True)
    assert rig.children("s2r_runtime.daemon.worker") == []
    assert "repair.timeout" in rig.status()["trace"]["reason"]
    rig.stop()
    (ended,) = [m for m in rig.messages("out/trace_ended") if isinstance(m, TraceEnded)]
    assert (ended.verdict, ended.reason) == ("", "not done within 0.3 s (repair.timeout)")
    assert [m.error for m in traces(rig)] == [ended.reason]


@pytest.mark.slow
def test_a_daemon_that_ends_takes_its_trace_along(rigs: Any) -> None:
    rig = rigs()
    assert rig.sample()["exit_code"] == 0
    rig.background("trace")
    (worker,) = rig.until(lambda: rig.children("s2r_runtime.daemon.worker"))
    rig.stop()
    rig.until(lambda: state(worker) in ("", "Z"))
    (ended,) = [m for m in rig.messages("out/trace_ended") if isinstance(m, TraceEnded)]
    assert ended.reason == "the daemon stopped before it was done"


def nice(pid: int) -> int:
    return int(fields(pid)[16] or 0)


def state(pid: int) -> str:
    return fields(pid)[0]


def fields(pid: int) -> list[str]:
    """Of proc(5), from the state on."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return [""] * 50


# ---------------------------------------------------------------- who decides


@pytest.mark.slow
def test_the_profile_may_decide_and_the_log_says_that_it_did(rigs: Any) -> None:
    rig = rigs('[repair]\nafter_campaign = true\nadopt = "always"\n', "--gain", "0.7")
    before = rig.status()["model"]
    assert rig.sample()["exit_code"] == 0
    status = rig.until(lambda: (found := rig.status())["model"] != before and found)
    assert (status["radius"], status["epoch"], status["proposal"]) == (None, 1, None)
    fresh = rig.sample()
    assert (fresh["exit_code"], fresh["data"]["epoch"], fresh["data"]["model_digest"]) == (0, 2, status["model"])
    rig.until(lambda: rig.status()["trace"]["epoch"] == 2)
    rig.stop()
    (adopted,) = [m for m in rig.messages("out/model_adopted") if isinstance(m, ModelAdopted)]
    assert (adopted.by, adopted.proposed) == (-1, True)
    rig.start()
    assert rig.status()["model"] == status["model"]


@pytest.mark.slow
def test_a_proposal_outlives_the_daemon_and_is_adopted_by_a_person(rigs: Any) -> None:
    rig = rigs("", "--gain", "0.7")
    assert (rig.ask("adopt")["exit_code"], "no model is proposed" in rig.ask("adopt")["text"]) == (2, True)
    assert rig.sample()["exit_code"] == 0
    done = rig.s2r("trace", "--live", "campaign", "--socket", str(rig.socket))
    assert (done.returncode, "input_gain on w" in done.stdout) == (0, True), done.stderr
    proposed = rig.status()["proposal"]
    rig.kill()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    assert rig.status()["proposal"] == proposed
    again = rig.ask("trace")
    assert (again["exit_code"], again["data"]["proposal"]["digest"]) == (0, proposed["digest"]), "the same rows, out of the log before"
    assert rig.s2r("adopt", "--socket", str(rig.socket)).returncode == 0
    assert rig.status()["model"] == proposed["digest"]
    spec = load_model(Path(proposed["path"]))
    stripped = rig.folder / "stripped.toml"
    stripped.write_text("".join(line for line in Path(proposed["path"]).read_text().splitlines(True) if not line.startswith("fitted_on")))
    rig.ask("adopt", text=stripped.read_text(), base=str(rig.folder))
    assert load_model(Path(proposed["path"])).fitted_on == spec.fitted_on, "what it was fitted on is not forgotten"
    rig.stop()
    first, second = rig.log_files()
    both = json.loads(rig.s2r("audit", str(first), str(second), "--json").stdout)
    assert (both["ok"], both["recomputed"]["traces run again"]) == (True, 2), both
    alone = json.loads(rig.s2r("audit", str(second), "--json").stdout)
    assert alone["ok"], alone
    assert any("was made on, in an earlier log that was not given" in one for one in alone["missing"])
    assert "traces run again" not in alone["recomputed"]


@pytest.mark.slow
def test_a_model_that_was_refused_is_not_the_one_in_force_after_a_restart(rigs: Any) -> None:
    rig = rigs("", "--gain", "0.7")
    assert rig.sample()["exit_code"] == 0
    assert rig.ask("trace")["exit_code"] == 0
    assert rig.ask("adopt")["exit_code"] == 0
    adopted = rig.status()["model"]
    assert rig.sample()["exit_code"] == 0
    waiting = rig.background("trace")
    rig.until(lambda: rig.status()["jobs"])
    other = "[model]\nname = 'unicycle'\ndt = 0.033\n"
    refused = rig.ask("adopt", text=other)
    assert (refused["exit_code"], "still works" in refused["text"]) == (1, True)
    waiting()
    rig.stop()
    rig.start()
    assert rig.status()["model"] == adopted


# ---------------------------------------------------------------- the command line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["sample", "rig.toml", "--inputs", "inputs.csv"], "--inputs: no daemon of robot 'rig' is running"),
        (["trace"], "give a RECORDING, or --live"),
        (["trace", "log.mcap", "--live", "drive"], "give a RECORDING, or --live"),
        (["trace", "--live", "drive", "--profile", "rig.toml"], "--profile: the daemon traces as its profile says"),
        (["trace", "--live", "drive", "--horizon", "2"], "--horizon: the daemon traces as its profile says"),
        (["trace", "--live", "drive"], "no daemon is running here"),
        (["adopt"], "no daemon is running here"),
    ],
)
def test_what_makes_no_sense_is_one_line(tmp_path: Path, argv: list[str], said: str) -> None:
    rig = Rig(tmp_path)
    inputs_file(rig, 3)
    done = rig.s2r(*argv)
    assert (done.returncode, said in done.stderr, done.stderr.count("\n")) == (2, True, 1), done.stderr


@pytest.mark.slow
def test_beside_a_file_of_inputs_nothing_else_is_asked_for(rigs: Any) -> None:
    rig = rigs()
    path = inputs_file(rig, 3)
    for more, said in (
        (["-n", "3"], "leave -n, --retry, --pause and --cancel out"),
        (["--cancel"], "leave -n, --retry, --pause and --cancel out"),
        ([], "no such file"),
    ):
        file = str(path) if more else "none.csv"
        done = rig.s2r("sample", str(rig.profile), "--inputs", file, *more)
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
    wrong = rig.folder / "wrong.toml"
    wrong.write_text(rig.profile.read_text() + '[repair]\nadopt = "never"\n')
    assert "repair.adopt" in rig.s2r("profile", "check", str(wrong)).stderr
    wrong.write_text(rig.profile.read_text() + "[repair]\nrows = 10\n")
    assert "repair.rows is 10, must be >= 100" in rig.s2r("profile", "check", str(wrong)).stderr
