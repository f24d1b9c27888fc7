"""Workers and analytics as processes: what they answer, and that they come to an end whatever happens to them or to the daemon."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from worker_rig import GRID, WITHIN_S, drained, finished, gap, gap_job, profile, step, verify_job

from s2r_runtime.child import Child
from s2r_runtime.controllers.file import load
from s2r_runtime.daemon.analytics import Analytics, Ready, Refused, Reply, Watching
from s2r_runtime.daemon.settings import fault_jump_of
from s2r_runtime.daemon.worker import Failed, LoadJob, Result, Upward, Worker
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.watch import measurement_fault
from s2r_runtime.messages import IMPLAUSIBLE

# ---------------------------------------------------------------- jobs


def test_worker_finds_the_gap_that_a_direct_call_finds() -> None:
    said = finished(gap_job())
    assert isinstance(said[-1], Result)
    assert said[-1].gap == gap()
    assert said[-1].gap is not None
    assert (said[-1].gap.n, said[-1].gap.rejected) == (8, {"timeout": 2})


def test_worker_says_how_many_samples_are_missing() -> None:
    said = finished(gap_job(3))
    assert isinstance(said[-1], Failed)
    assert "more" in said[-1].text


def test_verification_is_a_function_of_its_job_and_holds_every_scenarios_value() -> None:
    first, second = finished(verify_job())[-1], finished(verify_job())[-1]
    assert isinstance(first, Result)
    assert first == second
    assert first.verification is not None
    assert first.verification.passed, first.verification.reason
    assert {law.law: law.n for law in first.verification.laws} == {law: len(values) for law, values in first.safety.items()}
    assert {law.law: law.s_star for law in first.verification.laws} == {law: min(values) for law, values in first.safety.items()}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("    raise ValueError('no idea')\n", "no idea"),
        ("    return x\n", "must be"),
        ("    import os; os.fork()\n    return x[:, :2] * 0\n", "PermissionError"),
        ("    open('/tmp/escaped', 'w')\n    return x[:, :2] * 0\n", "PermissionError"),
    ],
    ids=["raises", "wrong shape", "forks", "writes"],
)
def test_controller_that_fails_in_verification_has_not_passed(tmp_path: Path, body: str, words: str) -> None:
    path = tmp_path / "bad.py"
    path.write_text(f"def control(x, theta, parameters):\n{body}")
    said = finished(verify_job(path))[-1]
    assert isinstance(said, Result)
    assert said.verification is not None
    assert not said.verification.passed
    assert words in said.verification.reason


def test_prints_of_a_controller_cost_nothing_even_where_stderr_is_a_file(tmp_path: Path) -> None:
    path = tmp_path / "grid.py"
    loud = "    import sys\n    print('step', flush=True)\n    print('step', file=sys.stderr, flush=True)\n"
    path.write_text("def control(x, theta, parameters):\n" + loud + "    return x[:, :2] * 0\n")
    kept = os.dup(2)
    with (tmp_path / "stderr").open("wb") as file:
        os.dup2(file.fileno(), 2)
        try:
            said = finished(verify_job(path))[-1]
        finally:
            os.dup2(kept, 2)
            os.close(kept)
    assert isinstance(said, Result), said
    assert said.verification is not None
    assert "Error" not in said.verification.reason
    assert said.safety
    assert b"step" not in (tmp_path / "stderr").read_bytes()


def test_controller_that_hangs_in_verification_is_killed_in_time(tmp_path: Path) -> None:
    path = tmp_path / "slow.py"
    path.write_text("import time\n\n\ndef control(x, theta, parameters):\n    time.sleep(1000)\n")
    said = finished(verify_job(path), timeout_s=3.0)
    assert said[-1] == Failed("not done within 3 s (verification.timeout)")


def test_controller_is_loaded_with_its_parameters() -> None:
    said = finished(LoadJob(str(GRID), msgspec.Raw(b'{"speed": 0.1}')))[-1]
    assert isinstance(said, Result)
    assert said.controller is not None
    assert said.controller.parameters["speed"] == 0.1
    assert said.controller == load(GRID, {"speed": 0.1})
    for path in (str(GRID.parent), "/dev/zero", "/nowhere.py"):
        assert finished(LoadJob(path))[-1] == Failed(f"{path}: is no file")


def test_killed_worker_is_a_job_that_failed() -> None:
    worker = Worker(verify_job(), WITHIN_S)
    os.kill(worker.pid, signal.SIGKILL)
    assert drained(worker) == [Failed("the worker died: killed by signal 9")]
    worker.stop()


@pytest.mark.parametrize("module", ["s2r_runtime.daemon.worker", "s2r_runtime.daemon.analytics"])
def test_children_end_when_their_parent_is_killed(module: str) -> None:
    program = f"import time; from s2r_runtime.child import Child; c = Child('{module}'); print(c.pid, flush=True); time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    limit = time.monotonic() + WITHIN_S
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2:3]:
        assert time.monotonic() < limit
        time.sleep(0.02)


def test_child_that_does_not_read_is_bounded_and_one_that_left_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    from s2r_runtime import child

    monkeypatch.setattr(child, "PENDING_MAX", 1 << 20)
    one = Child("s2r_runtime.daemon.worker")
    os.kill(one.pid, signal.SIGSTOP)
    for _ in range(64):
        one.send(b"x" * (1 << 16))
    assert not one.alive()
    one.stop()
    assert one.ending() == "killed by signal 9"
    assert one.wait(0.1) is None


# ---------------------------------------------------------------- analytics


@pytest.fixture
def analytics() -> Iterator[Analytics]:
    started = Analytics(profile(), "test.toml")
    yield started
    started.stop()
    started.stop()


def replies(came: list[Upward] | list[Ready | Refused | Reply]) -> list[Reply]:
    return [message for message in came if isinstance(message, Reply)]


def test_analytics_tells_the_models_facts_and_measures_every_transition(analytics: Analytics) -> None:
    facts = analytics.facts()
    assert (facts.states, facts.inputs, facts.angles) == (("x", "y", "theta"), ("v", "w"), ("theta",))
    assert facts.horizon == 200
    analytics.watch(Watching(profile().model, gap(), 0.5))
    measured = []
    for k, x in enumerate((0.0, 0.0, 0.001, 0.001, 0.9)):
        observation, send = step(k, x)
        analytics.observed(observation)
        (reply,) = replies(analytics.wait())
        analytics.sent(send)
        assert reply.obs_seq == k
        measured.append(reply.measured)
    assert measured[0] is None
    found = [(round(m.discrepancy, 6), m.fault, m.n, m.exceedances, m.epoch) for m in measured[1:] if m is not None]
    assert found == [(0.0, "", 1, 0, 1), (0.001, "", 2, 1, 1), (0.0, "", 3, 1, 1), (0.899, "jump", 3, 1, 1)]


def test_analytics_goes_on_where_the_watch_stood(analytics: Analytics) -> None:
    analytics.facts()
    analytics.watch(Watching(profile().model, gap(), 0.0, n=100, exceedances=40, e_value=17.0))
    for k in range(2):
        observation, send = step(k, 0.0)
        analytics.observed(observation)
        reply = replies(analytics.wait())[-1]
        analytics.sent(send)
    assert reply.measured is not None
    assert (reply.measured.n, reply.measured.exceedances) == (101, 40)
    assert 1.0 < reply.measured.e_value < 17.5


def test_profile_with_a_wrong_name_is_refused_by_the_process_that_loads_it() -> None:
    wrong = msgspec.structs.replace(profile(), region={"z": (0.0, 1.0)})
    process = Analytics(wrong, "wrong.toml")
    with pytest.raises(ConfigError, match=r"wrong\.toml: region\.z"):
        process.facts()
    process.stop()


@pytest.mark.parametrize(("how", "words"), [(signal.SIGKILL, "killed by signal 9"), (signal.SIGSTOP, "no longer answers")])
def test_analytics_that_died_or_froze_is_down(analytics: Analytics, how: signal.Signals, words: str) -> None:
    analytics.facts()
    analytics.watch(Watching(profile().model, gap(), 0.0))
    os.kill(analytics.pid, how)
    analytics.observed(step(0, 0.0)[0])
    assert replies(analytics.wait()) == []
    assert words in analytics.down


def test_a_glitch_that_no_motion_makes_is_a_fault_by_default_and_not_under_the_rules_of_before() -> None:
    """Twice the extent of the geofence, in the norm: a discrepancy of 1e9 is none, one of half the region is."""
    robot = profile()
    plain = msgspec.structs.replace(robot, watch=msgspec.structs.replace(robot.watch, fault_jump=0.0))
    states, angles = ("x", "y", "theta"), ("theta",)
    fence = {**plain.region, **plain.geofence}
    extent = math.hypot(*(w * (math.pi if s == "theta" else fence[s][1] - fence[s][0]) for s, w in zip(states, gap().weights, strict=True)))
    jump = fault_jump_of(plain, states, angles, gap())
    assert jump == pytest.approx(2.0 * extent)
    assert measurement_fault(1e9, jump) == "jump"
    assert measurement_fault(0.5 * extent, jump) == ""
    assert fault_jump_of(plain, states, angles, gap(), IMPLAUSIBLE - 1) == 0.0
    own = msgspec.structs.replace(robot, watch=msgspec.structs.replace(robot.watch, fault_jump=0.3))
    assert fault_jump_of(own, states, angles, gap()) == 0.3
    assert plain.digest() == msgspec.structs.replace(plain, watch=type(plain.watch)()).digest()
