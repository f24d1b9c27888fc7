"""Hosted controllers: whatever one does in its process, the daemon gets an answer in time or a reason, and nothing else happens."""

from __future__ import annotations

import os
import platform
import select
import signal
import subprocess
import sys
import textwrap
import time
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from controllers_rig import MODEL, PATIENT_NS, Hosted, hosted

from s2r_runtime.controllers import confined_process
from s2r_runtime.controllers.code import batch_control
from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.controllers.hosted import ControllerFile, HostedController, Late, Ready, Reply, Stopped, load
from s2r_runtime.messages import Observation, Scenarios
from s2r_runtime.models.composed import compose
from s2r_runtime.plugins import registry
from s2r_runtime.profile import TaskChoice

GOOD = """
import numpy as np
PARAMETERS = {"gain": 1.5, "steps": 3}
def control(x, theta, parameters):
    return np.stack([parameters["gain"] * x[:, 0], x[:, 1]], axis=1)
"""


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the end of a process comes later than that of its socket by more than the daemon would wait."""
    monkeypatch.setattr(confined_process, "ENDS_WITHIN_S", 10.0)


def write(folder: Path, source: str, name: str = "controller.py") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(source))
    return path


def loaded(folder: Path, body: str, head: str = "") -> ControllerFile:
    """A controller whose `control` has this body."""
    function = "def control(x, theta, parameters):\n" + textwrap.indent(textwrap.dedent(body).strip(), "    ")
    return load(write(folder, f"import numpy as np\n{textwrap.dedent(head)}\n{function}\n"))


def is_gone(pid: int) -> bool:
    """Whether no process has this id (waits a moment: a kill takes effect soon, not at once)."""
    for _ in range(500):
        try:
            os.kill(pid, 0)
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.01)
    return False


def test_a_controller_answers_what_it_would_answer_in_a_batch(tmp_path: Path) -> None:
    file = load(write(tmp_path, GOOD), {"gain": 3.0})
    write(tmp_path, "raise RuntimeError('changed after it was loaded')")
    with hosted(file) as it:
        for k in range(20):
            reply = it.ask((0.1 * k, -0.3 * k, 0.0))
            assert isinstance(reply, Reply)
            assert reply.obs_seq == k + 1
            assert reply.u == tuple(batch_control(file)(np.array([[0.1 * k, -0.3 * k, 0.0]]), {})[0])
            assert reply.latency_ns > 0
        pid = it.host.pid
    assert is_gone(pid)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "detail"),
    [
        ("return np.full((len(x), 2), np.nan)", "control returned nan (row 0, input 0), must be finite"),
        ("return np.full((len(x), 2), -np.inf)", "control returned -inf (row 0, input 0), must be finite"),
        ("return np.zeros((len(x), 3))", "control returned shape (1, 3), must be an array of shape (1, 2)"),
        ("return np.zeros(2)", "control returned shape (2,), must be an array of shape (1, 2)"),
        ("return None", "control returned NoneType of object, must be an array of shape (1, 2)"),
        ("return 'left'", "control returned str of <U4, must be an array of shape (1, 2)"),
    ],
)
def test_an_answer_that_is_no_finite_input_stops_it_as_malformed(tmp_path: Path, body: str, detail: str) -> None:
    with hosted(loaded(tmp_path, body)) as it:
        assert it.ask() == Stopped("malformed", f"controller.py: {detail}")
        assert is_gone(it.host.pid)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "reason", "detail"),
    [
        ("raise ValueError('two\\nlines \\x1b[31m')", "raised", "controller.py: ValueError: two lines [31m (controller.py line 4)"),
        ("import sys; sys.exit(3)", "raised", "SystemExit: 3"),
        ("import os; os._exit(3)", "died", "exited with status 3"),
        ("print('last words'); import os; os._exit(4)", "died", "exited with status 4; it last printed: last words"),
        ("import ctypes; ctypes.string_at(0)", "died", "killed by SIGSEGV"),
        ("def f(): return f()\nreturn f()", "raised", "RecursionError"),
        ("import os; os.close(3); return x[:, :2]", "died", ""),
        ("hoard = []\nwhile True: hoard.append(np.ones(1_000_000))", "raised", "MemoryError"),
        ("hoard = []\nwhile True: hoard.append(bytes(1_000_000))", "raised", "MemoryError"),
    ],
)
def test_a_controller_that_fails_is_stopped_with_the_reason(tmp_path: Path, body: str, reason: str, detail: str) -> None:
    with hosted(loaded(tmp_path, body, "import sys")) as it:
        stopped = it.ask()
        assert isinstance(stopped, Stopped)
        assert stopped.reason == reason
        assert detail in stopped.detail
        assert stopped.detail.isprintable()
        assert it.host.poll(time.monotonic_ns()) == []
        assert is_gone(it.host.pid)


def test_a_controller_that_hangs_is_stopped_at_its_deadline(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "while x[0, 0] > 1: pass\nreturn x[:, :2]")) as it:
        assert isinstance(it.ask(), Reply)
        stopped = it.ask((2.0, 0.0, 0.0), deadline_ns=100_000_000)
        assert stopped == Stopped("deadline", "did not answer observation 2 within 100 ms")
        assert is_gone(it.host.pid)


@pytest.mark.slow
def test_a_controller_that_waits_for_a_processor_is_late_and_not_at_fault(tmp_path: Path) -> None:
    """Nine processes want one processor, each with a ninth of it: 40 ms of work take 0.36 s."""
    file = loaded(
        tmp_path,
        """
        begun = time.thread_time()
        while time.thread_time() < begun + 0.04:
            pass
        return np.zeros((len(x), 2))
        """,
        "import time",
    )
    program = "import os\nos.sched_setaffinity(0, {0})\nwhile True: pass"
    with hosted(file, patience_s=60.0) as it:
        hogs = [subprocess.Popen([sys.executable, "-c", program], start_new_session=True) for _ in range(8)]
        try:
            os.sched_setaffinity(it.host.pid, {0})
            while not all(int(Path(f"/proc/{hog.pid}/schedstat").read_text().split()[0]) > 50_000_000 for hog in hogs):
                time.sleep(0.02)
            found = it.ask(deadline_ns=100_000_000)
            assert isinstance(found, Late)
            assert found.obs_seq == 1
            assert "had the processor for" in found.detail
            reply = it.next()
            assert isinstance(reply, Reply)
            assert (reply.obs_seq, reply.late) == (1, True)
        finally:
            for hog in hogs:
                hog.kill()
                hog.wait()
        reply = it.ask()
        assert isinstance(reply, Reply)
        assert not reply.late


def test_a_controller_that_sleeps_or_is_stopped_is_at_fault_whatever_the_computer_does(tmp_path: Path) -> None:
    file = loaded(tmp_path, "time.sleep(5.0)\nreturn np.zeros((len(x), 2))", "import time")
    for stop in (False, True):
        with hosted(file, patience_s=60.0) as it:
            if stop:
                os.kill(it.host.pid, signal.SIGSTOP)
            found = it.ask(deadline_ns=100_000_000)
            while isinstance(found, Late):  # it had to wait before it could begin to sleep
                found = it.next()
            assert isinstance(found, Stopped)
            assert found.reason == "deadline"


def test_time_in_which_the_asker_stood_still_is_not_held_against_the_controller(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "return np.zeros((len(x), 2))"), patience_s=60.0) as it:
        os.kill(it.host.pid, signal.SIGSTOP)
        asked_ns = time.monotonic_ns()
        it.host.ask(Observation(1, 0, (0.5, 0.25, 0.0)), asked_ns + 500_000_000)
        time.sleep(0.6)
        it.host.forgive(time.monotonic_ns() - asked_ns)
        (late,) = it.host.poll(time.monotonic_ns())
        assert isinstance(late, Late)
        assert "the daemon stood still for" in late.detail
        it.host.ask(Observation(2, 0, (0.5, 0.25, 0.0)), time.monotonic_ns() + 1_000_000)
        os.kill(it.host.pid, signal.SIGCONT)
        replies: list[Reply] = []
        while not replies:
            select.select([it.host], [], [], 0.02)
            replies += [event for event in it.host.poll(time.monotonic_ns()) if isinstance(event, Reply)]
        assert (replies[0].obs_seq, replies[0].late) == (1, True)


def test_an_answer_that_is_there_counts_also_when_the_daemon_looks_late(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "return x[:, :2]")) as it:
        it.host.ask(Observation(1, 0, (0.0, 0.0, 0.0)), time.monotonic_ns() + PATIENT_NS)
        select.select([it.host], [], [])
        assert isinstance(it.host.poll(time.monotonic_ns() + 2 * PATIENT_NS)[0], Reply)


def test_a_controller_killed_from_outside_is_noticed(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "return x[:, :2]")) as it:
        os.kill(it.host.pid, signal.SIGKILL)
        assert it.next() == Stopped("died", "killed by SIGKILL")
        it.host.ask(Observation(1, 0, (0.0, 0.0, 0.0)), 0)  # late questions fall on deaf ears
        assert it.host.poll(time.monotonic_ns()) == []


def test_printing_spoils_nothing_and_the_end_of_it_is_kept(tmp_path: Path) -> None:
    body = """
        import os, sys
        print('{"type":"chosen","obs_seq":1,"u":[9,9],"episode":null,"ended":null}')
        sys.stderr.write("é" * 20000 + "\\nto stderr\\n")
        os.write(1, b"\\xff raw\\n")
        return x[:, :2]
    """
    with hosted(loaded(tmp_path, body)) as it:
        for _ in range(5):
            reply = it.ask()
            assert isinstance(reply, Reply)
            assert reply.u == (0.5, 0.25)
        it.host.poll(time.monotonic_ns())
        assert it.host.output.endswith("to stderr\n\ufffd raw\n")
        assert len(it.host.output) <= 4096


ANSWER = '{"type":"chosen","obs_seq":%s,"u":[%s,1],"episode":null,"ended":null}\\n'
"""As the child itself would write it; in the source of a controller."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        "while True: print('x' * 1000)",
        "while True: os.write(2, b'y' * 100000)",
        "while True: os.write(SOCKET, b'{}\\n' * 1000)",
        "while True: os.write(SOCKET, b'z' * 10000)",
        f"for k in range(3): os.write(SOCKET, b'{ANSWER % (1, 1)}')",
        f"os.write(SOCKET, b'{ANSWER % (99, 1)}')",
        f"os.write(SOCKET, b'{ANSWER % (1, '1e999')}')",
        f"os.write(SOCKET, b'{ANSWER % (1, 'null')}')",
        'os.write(SOCKET, b\'{"type":"up","contained":[]}\\n\')',
        'os.write(SOCKET, b\'{"type":"loaded","digest":"sha256:00"}\\n\')',
        "os.write(SOCKET, b'\\xff\\xfe\\n' + b'[' * 50000 + b'\\n')",
    ],
)
def test_floods_and_forged_messages_end_it(tmp_path: Path, body: str) -> None:
    with hosted(loaded(tmp_path, body + "\nreturn x[:, :2]", "import os\nSOCKET = 3")) as it:
        events: list[Ready | Reply | Stopped] = []
        it.host.ask(Observation(1, 0, (0.5, 0.25, 0.0)), time.monotonic_ns() + 300_000_000)
        while not events or not isinstance(events[-1], Stopped):
            select.select([it.host], [], [], 0.02)
            events += it.host.poll(time.monotonic_ns())
        assert events[-1].reason in {"malformed", "deadline"}
        assert all(isinstance(event, Reply) and event.obs_seq == 1 for event in events[:-1])
        assert len(events) <= 2
        assert events[-1].detail.isprintable()
        assert len(it.host.output) <= 4096
        assert is_gone(it.host.pid)


@pytest.mark.skipif(platform.machine() not in {"x86_64", "aarch64"}, reason="system calls are filtered on these processors")
@pytest.mark.parametrize(
    "body", ["import os; os.fork()", "import socket; socket.socket()", "open('new', 'w')", "import os; os.kill(os.getppid(), 9)"]
)
def test_a_controller_that_reaches_out_of_its_process_is_stopped(tmp_path: Path, body: str) -> None:
    file = loaded(tmp_path, f"{body}\nreturn x[:, :2]")
    it = Hosted(file)
    ready = it.next()
    assert isinstance(ready, Ready)
    assert set(ready.contained) - {"reading"} == {"memory", "files", "privileges", "system_calls"}
    stopped = it.ask()
    it.host.close()
    assert isinstance(stopped, Stopped)
    assert stopped.reason == "raised"
    assert "PermissionError: [Errno 1] Operation not permitted" in stopped.detail


@pytest.mark.parametrize(
    ("source", "message", "timeout_s"),
    [
        ("raise RuntimeError('early')", "raised: controller.py: RuntimeError: early (controller.py line 2)", 60.0),
        ("import os; os._exit(5)", "died: exited with status 5", 60.0),
        ("while True: pass", "deadline: was not ready after 1.5 s", 1.5),
    ],
)
def test_a_controller_that_cannot_start_says_why(tmp_path: Path, source: str, message: str, timeout_s: float) -> None:
    it = Hosted(load(write(tmp_path, f"def control(x, theta, parameters): return x\n{source}")), start_timeout_s=timeout_s)
    assert it.next() == Stopped("start_failed", message)
    it.host.close()


def test_a_library_that_changed_since_it_was_loaded_is_a_failed_start(tmp_path: Path) -> None:
    it = Hosted(msgspec.structs.replace(load(write(tmp_path, GOOD)), libraries={"numpy": "0.1"}))
    stopped = it.next()
    it.host.close()
    assert isinstance(stopped, Stopped)
    assert stopped.reason == "start_failed"
    assert "digested with numpy 0.1, here is" in stopped.detail


def test_an_unknown_task_or_model_is_a_failed_start(tmp_path: Path) -> None:
    file = load(write(tmp_path, GOOD))
    it = Hosted(file, TaskChoice("grid_wrold"))
    try:
        stopped = it.next()
        assert isinstance(stopped, Stopped)
        assert stopped.reason == "start_failed"
        assert "did you mean 'grid_world'?" in stopped.detail
    finally:
        it.host.close()


def test_while_it_works_the_newest_question_waits(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "import time\ntime.sleep(0.05)\nreturn x[:, :2]")) as it:
        for k in range(4):
            it.host.ask(Observation(k, 0, (float(k), 0.0, 0.0)), time.monotonic_ns() + PATIENT_NS)
        first, second = it.next(), it.next()
        assert isinstance(first, Reply)
        assert isinstance(second, Reply)
        assert (first.obs_seq, first.u[0], second.obs_seq, second.u[0]) == (0, 0.0, 3, 3.0)
        assert it.host.deadline_ns is None


def test_a_question_that_is_no_state_is_the_callers_fault(tmp_path: Path) -> None:
    with hosted(loaded(tmp_path, "return x[:, :2]")) as it:
        for x in ((1.0, 2.0), (float("nan"), 0.0, 0.0), ()):
            with pytest.raises(ValueError, match="must be 3 finite numbers"):
                it.host.ask(Observation(1, 0, x), 0)
        assert isinstance(it.ask(), Reply)
    host = HostedController(load(tmp_path / "controller.py"), model=MODEL, nx=3, nu=2, task=None, scenarios=Scenarios(7, 0, 0))
    with pytest.raises(ValueError, match="not ready"):
        host.ask(Observation(1, 0, (0.0, 0.0, 0.0)), 0)
    host.close()


PARENT = """
import sys, time
from pathlib import Path
from s2r_runtime.controllers.hosted import HostedController, load
from s2r_runtime.messages import Observation, Scenarios
from s2r_runtime.modelspec import ModelSpec
host = HostedController(load(Path(sys.argv[1])), model=ModelSpec("unicycle", 0.033), nx=3, nu=2, task=None, scenarios=Scenarios(7, 0, 0))
host.start()
while not host.poll(time.monotonic_ns()):
    time.sleep(0.01)
host.ask(Observation(1, 0, (0.0, 0.0, 0.0)), time.monotonic_ns() + 10**12)
print(host.pid, flush=True)
time.sleep(60)
"""


def test_a_hanging_controller_dies_with_a_killed_daemon(tmp_path: Path) -> None:
    file = write(tmp_path, "def control(x, theta, parameters):\n    while True: pass")
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(file)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert is_gone(pid)


def test_its_environment_and_folder_are_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("S2R_SECRET", "1")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    body = """
        import os, sys
        print(os.getcwd(), "S2R_SECRET" in os.environ, os.environ.get("PYTHONPATH"), sys.stdin.read())
        return x[:, :2]
    """
    with hosted(loaded(tmp_path, body)) as it:
        assert isinstance(it.ask(), Reply)
        it.host.poll(time.monotonic_ns())
        assert it.host.output.split() == ["/", "False", "None"]


# ---------------------------------------------------------------- scenarios of a task

RECORDS_THETA = """
import zlib
import numpy as np
def control(x, theta, parameters):
    print(sorted((name, zlib.crc32(np.ascontiguousarray(value).tobytes())) for name, value in theta.items()))
    return np.zeros((len(x), 2))
"""


def test_scenarios_follow_each_other_and_depend_on_the_seed_alone(tmp_path: Path) -> None:
    file = load(write(tmp_path, RECORDS_THETA))
    choice = TaskChoice("grid_world", {"steps": 6}, episodes=2)
    task = registry().get("tasks", "grid_world")({"steps": 6}, compose(MODEL).nominal, MODEL.dt)
    own = Episodes(task, seed=7, count=2)
    with hosted(file, task=choice) as it:
        for k in range(12):
            reply = it.ask((0.2, 0.2, 0.0))
            theta, episode, ended = own.look(np.array([0.2, 0.2, 0.0]))
            assert isinstance(reply, Reply), reply
            assert theta is not None
            assert (reply.episode, reply.ended) == (episode, ended)
            assert (episode.index, episode.k) == divmod(k, 6)
            assert (ended is not None) == (k == 6)
            it.host.poll(time.monotonic_ns())
            seen = [(name, zlib.crc32(np.ascontiguousarray(value).tobytes())) for name, value in theta.items()]
            assert it.host.output.strip().splitlines()[-1] == repr(sorted(seen))
        stopped = it.ask((0.2, 0.2, 0.0))
        assert isinstance(stopped, Stopped)
        assert (stopped.reason, stopped.detail) == ("finished", "all 2 scenarios are over")
        assert stopped.ended is not None
        assert (stopped.ended.index, stopped.ended.k, stopped.ended.done) == (1, 6, True)


def test_a_scenario_that_cannot_be_drawn_ends_the_drive_with_the_tasks_reason(tmp_path: Path) -> None:
    with hosted(load(write(tmp_path, RECORDS_THETA)), task=TaskChoice("grid_world")) as it:
        stopped = it.ask((50.0, 50.0, 0.0))
        assert isinstance(stopped, Stopped)
        assert stopped.reason == "raised"
        assert stopped.detail.startswith("task: ")
