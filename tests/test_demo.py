"""The demo, whole: three processes over real Zenoh, with an effect switched on behind the daemon's back."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from s2r_runtime import messages as m
from s2r_runtime.cli.demonstration import DRIVES, Demonstration, _unwound_by
from s2r_runtime.messages import SERIAL
from s2r_runtime.recording.writer import read_all


def s2r(*argv: str | Path, timeout: float = 420) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "s2r_runtime.cli.main", *map(str, argv)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A whole run with another seed than the docs', and another effect."""
    out = tmp_path_factory.mktemp("demo") / "run"
    done = s2r("demo", "--seed", "7", "--effect", "input_gain:v gain=0.8", "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    return out, done.stdout


def events(out: Path) -> list[object]:
    return [entry.message for entry in read_all(sorted((out / "logs").glob("*.mcap"))).entries()]


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_the_story_refuses_repairs_certifies_drives_and_revokes(story: tuple[Path, str]) -> None:
    out, text = story
    for words in (
        "refused: verification attempt 1",
        "exit code 1",
        "input_gain on v",
        "model adopted",
        "deployed under certificate",
        "the gate is closed",
    ):
        assert words in text
    log = events(out)
    gaps = [e.gap for e in log if isinstance(e, m.EpochChanged) and e.gap is not None]
    assert len(gaps) == 2
    assert gaps[1].hold_radius < 0.2 * gaps[0].hold_radius
    assert any(isinstance(e, m.CertificateInstalled) for e in log)
    assert any(isinstance(e, m.Revoked) for e in log)


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_the_tracer_found_what_was_switched_on(story: tuple[Path, str]) -> None:
    traces = [e.trace for e in events(story[0]) if isinstance(e, m.JobFinished) and e.trace is not None]
    assert len(traces) == 1
    trace = traces[0]
    assert trace["verdict"] == "traced"
    (effect,) = trace["effects"]  # type: ignore[misc]
    assert (effect["name"], effect["channel"]) == ("input_gain", "v")
    assert effect["parameters"]["gain"]["value"] == pytest.approx(0.8, rel=0.02)
    error = trace["error"]
    assert error["after"]["rollout_rms"]["x"] < 0.2 * error["before"]["rollout_rms"]["x"]  # type: ignore[index]


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_nothing_but_recovery_and_sampler_commands_went_out_without_a_certificate(story: tuple[Path, str]) -> None:
    certified = False
    driven = 0
    for e in events(story[0]):
        if isinstance(e, m.CertificateInstalled):
            certified = True
        elif isinstance(e, m.Revoked):
            certified = False
        elif isinstance(e, m.Send) and e.source == "controller":
            driven += 1
            assert certified
    assert driven > 100


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_its_log_passes_the_audit_by_the_public_key_alone(story: tuple[Path, str]) -> None:
    """The demo shows the verdict and the certificate of the same command."""
    out, text = story
    (log,) = (out / "logs").glob("*.mcap")
    command, shown = text.split("$ s2r audit ", 1)[1].split("\n", 1)
    assert command.startswith(f"{log} --key {out / 'state' / 'key.pub'} --rerun-controllers")
    assert shown.lstrip().startswith("holds: ")
    assert re.search(r"^   certificate  sha256:[0-9a-f]+: valid: ", shown, re.MULTILINE)
    done = s2r("audit", log, "--key", out / "state" / "key.pub", "--rerun-controllers")
    assert done.returncode == 0
    assert re.search(r"^chain        intact; signed by ed25519:[0-9a-f]+, the trusted key;", done.stdout, re.MULTILINE)
    assert re.search(r" [1-9][0-9]* verifications run again$", done.stdout, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_the_story_fits_on_a_screen_and_a_half(story: tuple[Path, str]) -> None:
    assert len(story[1].splitlines()) <= 60


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_its_report_is_one_page_with_the_plots(story: tuple[Path, str]) -> None:
    page = (story[0] / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") >= 8
    assert len(page) < 5_000_000
    assert re.findall(r"""(?:src|href)\s*=\s*["'](?!#|data:)[^"']+""", page) == []


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_a_campaign_that_is_refused_for_its_order_is_drawn_once_more_and_no_oftener(tmp_path: Path) -> None:
    """The robot's speed swings once in 500 s, so that a sample's error is like that of the one before."""
    done = s2r("demo", "--effect", "periodic_disturbance:v frequency=0.002 amplitude=0.1 phase=0", "--out", tmp_path / "run")
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stdout.count("were not drawn independently") == 2
    assert done.stdout.count("repeat, with the next share of the error budget beta") == 1
    assert "after one step" not in done.stdout  # a refused campaign has no gap to tell
    log = events(tmp_path / "run")
    assert [e.gap.epoch for e in log if isinstance(e, m.JobFinished) and e.gap is not None] == [1, 2]
    assert not any(isinstance(e, m.CertificateInstalled) or (isinstance(e, m.Send) and e.source == "controller") for e in log)


def test_an_effect_that_the_robot_does_not_have_is_one_line(tmp_path: Path) -> None:
    done = s2r("demo", "--effect", "nonsense", "--out", tmp_path / "run")
    assert done.returncode == 78
    assert "unknown effect 'nonsense'" in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_a_demo_that_is_ended_takes_its_robot_and_its_daemon_with_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    argv = [sys.executable, "-m", "s2r_runtime.cli.main", "demo", "--out", str(out)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as demo:
        try:
            assert demo.stdout is not None
            assert any("campaign of epoch 1 begins" in line for line in demo.stdout)
            every = [int(folder.name) for folder in Path("/proc").iterdir() if folder.name.isdecimal()]
            theirs = [pid for pid in every if parent(pid) == demo.pid]
            assert len(theirs) == 2, "the robot and the daemon"
        finally:
            demo.terminate()
    assert demo.returncode == 128 + signal.SIGTERM
    assert not any(Path(f"/proc/{pid}").exists() for pid in theirs)
    assert " ends at " in (out / "daemon.txt").read_text(encoding="utf-8"), "the daemon has closed its log"


def parent(pid: int) -> int | None:
    """None where the process has ended meanwhile."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
    except OSError:
        return None


class Told(Demonstration):
    """A demo that hears a daemon's answers from a list: how a drive ends that seldom ends so. The last one is repeated."""

    def __init__(self, out: Path, *answers: dict[str, object]) -> None:
        super().__init__("robotarium", out, 1, None, None)
        self.asked: list[str] = []
        self._answers = list(answers)

    def _call(self, request: dict[str, object]) -> dict[str, object]:
        if request["verb"] != "status":
            self.asked.append(str(request["verb"]))
        if request["verb"] in {"permit", "clear"}:
            return {"exit_code": 0, "text": "done"}
        return self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]


def over(reason: str, *latched: str, **more: object) -> dict[str, object]:
    return {"exit_code": 0, "text": "", "data": {"gate": "closed", "reason": reason, "latched": list(latched), **more}}


RUNS, ENDED = "import time; time.sleep(60)", ""
REVOKED, HUNG = over("certificate_revoked", revoked={"a": "b"}), over("latched:controller_fault", "controller_fault")
AGAIN = {"exit_code": 0, "text": "deployed under certificate c"}
FAILED = {
    "exit_code": 1,
    "text": "refused: verification attempt 4 at radius 2 failed: under uniform 3 of 297 rollouts score below 0, the worst -1",
}
BROKEN = {"exit_code": 1, "text": "refused: the controller failed (start_failed: no such module)"}


@pytest.mark.parametrize(
    ("answers", "asked", "held", "words"),
    [
        ([REVOKED, FAILED], ["deploy"], True, "the fallback controller has stopped the robot"),
        ([HUNG, AGAIN, REVOKED, AGAIN, REVOKED, FAILED], ["clear", "deploy", "deploy", "deploy"], True, "has stopped the robot"),
        ([over("latched:watch_alarm", "watch_alarm")], [], True, "has stopped the robot"),
        ([over("no_controller")], [], True, "has stopped the robot"),
        ([over("latched:recorder_down", "recorder_down")], [], False, "closed for another reason than the gap"),
        ([REVOKED, BROKEN], ["deploy"], False, "another reason than its behaviour on the model"),
        ([x for _ in range(DRIVES) for x in (REVOKED, AGAIN)], ["deploy"] * (DRIVES - 1), False, f"stopped {DRIVES} times"),
    ],
)
def test_a_drive_ends_as_evidence_says_or_the_demo_says_that_it_does_not(
    answers: list[dict[str, object]],
    asked: list[str],
    held: bool,
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    demo = Told(tmp_path / "run", *answers)
    with subprocess.Popen([sys.executable, "-c", RUNS]) as robot:
        assert demo._watch_it(robot) is held
        robot.kill()
    assert demo.asked == asked
    said = capsys.readouterr().out
    assert words in said
    assert "the gate is still open" not in said


@pytest.mark.parametrize(
    ("answer", "held", "words"),
    [
        (FAILED, True, "still refused"),
        ({"exit_code": 1, "text": "refused: watch_alarm: the gap of epoch 2 was refuted"}, True, "still refused"),
        (BROKEN, False, "unexpected end"),
        ({**FAILED, "exit_code": 70}, False, "unexpected end"),
    ],
)
def test_a_repaired_model_that_is_refused_is_refused_for_what_was_measured(
    answer: dict[str, object], held: bool, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo = Told(tmp_path / "run", answer)
    with subprocess.Popen([sys.executable, "-c", ENDED]) as robot:
        assert demo._drive(robot, Path("grid.py"), running=False) is held
    assert words in capsys.readouterr().out


def _hung_up_and_ended() -> None:
    with _unwound_by(signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(("change", "words"), [("nonsense", "unknown effect 'nonsense'"), ("input_gain:v", "lacks the parameter gain")])
def test_a_change_that_the_robot_cannot_have_is_told_before_anything_begins(change: str, words: str, tmp_path: Path) -> None:
    done = s2r("demo", "--change", change, "--out", tmp_path / "run", timeout=60)
    assert done.returncode == 78
    assert len(done.stderr.splitlines()) == 1
    assert "--change" in done.stderr
    assert words in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_hang_up_that_was_ignored_before_is_ignored_on() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with pytest.raises(SystemExit) as left:
            _hung_up_and_ended()
        assert left.value.code == 128 + signal.SIGTERM
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_drive_whose_robot_is_gone_is_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo = Told(tmp_path / "run", over("link_down", controller="c"))
    with subprocess.Popen([sys.executable, "-c", ENDED]) as robot:
        robot.wait(30)
        assert demo._watch_it(robot) is False
    assert demo.asked == []
    assert "the robot's process has ended" in capsys.readouterr().out


def test_each_campaign_has_a_permit_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that is drawn once more takes as long as the first, and a permit lasts for one."""
    demo = Told(tmp_path / "run", {"exit_code": 1, "text": f"refused: {SERIAL}"}, {"exit_code": 0, "text": "taken"})
    assert demo._campaign() is True
    assert demo.asked == ["permit", "sample", "permit", "sample"]
    assert "repeat" in capsys.readouterr().out
