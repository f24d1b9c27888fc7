"""The control socket and the line to systemd: who is heard, and that nobody who talks badly or slowly holds the daemon up."""

from __future__ import annotations

import configparser
import contextlib
import json
import os
import selectors
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from s2r_runtime.daemon import control
from s2r_runtime.daemon.control import Connection, ControlServer, call, find_socket
from s2r_runtime.daemon.door import Request
from s2r_runtime.daemon.systemd import Notifier
from s2r_runtime.errors import ConfigError, UsageError


class Desk:
    """A server with a loop in a thread, that answers `echo` with its request and `slow` after some progress."""

    def __init__(self, path: Path) -> None:
        self.selector = selectors.DefaultSelector()
        self.server = ControlServer(path, self.selector, self.on_request)
        self.server.open()
        self.turns = 0
        self.waiting: list[Connection] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def on_request(self, connection: Connection, request: Request) -> None:
        match request.verb:
            case "echo":
                connection.answer(0, "as you said", {"verb": request.verb, "text": request.text})
            case "slow":
                connection.progress(done=1, total=2)
                connection.progress(text="half way")
                connection.answer(3, "not enough")
            case "flood":
                connection.answer(0, "x" * (6 << 20))
            case "wait":
                self.waiting.append(connection)

    def _loop(self) -> None:
        while not self._stop.is_set():
            for key, mask in self.selector.select(0.01):
                key.data(mask)
            self.turns += 1
            self.server.tick(time.monotonic_ns())

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()
        self.server.close()
        self.selector.close()


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    opened = Desk(control.socket_dir() / "rover.sock")
    yield opened
    opened.close()


def raw(desk: Desk, data: bytes) -> bytes:
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(10.0)
        sock.connect(str(desk.server.path))
        sock.sendall(data)
        answer = b""
        with contextlib.suppress(ConnectionError):
            while part := sock.recv(1 << 16):
                answer += part
        return answer


def test_request_is_answered_with_progress_first(desk: Desk) -> None:
    heard: list[Request] = []
    answer = call(desk.server.path, {"verb": "slow"}, heard.append)
    assert (answer["exit_code"], answer["text"]) == (3, "not enough")
    assert heard == [{"done": 1, "total": 2}, {"text": "half way"}]
    assert call(desk.server.path, {"verb": "echo", "text": "ä"})["data"] == {"verb": "echo", "text": "ä"}


def test_socket_and_its_folder_are_the_owners_alone(desk: Desk) -> None:
    assert stat.S_IMODE(desk.server.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(desk.server.path.parent.stat().st_mode) == 0o700


@pytest.mark.parametrize("data", [b"not json\n", b"[]\n", b"{}\n", b'{"verb": 1}\n', b"[" * 100_000 + b"\n", b"\xff\xfe\n"])
def test_what_is_no_request_is_answered_as_such(desk: Desk, data: bytes) -> None:
    assert json.loads(raw(desk, data).splitlines()[-1])["exit_code"] == 2
    assert call(desk.server.path, {"verb": "echo"})["exit_code"] == 0


def test_endless_request_is_cut_off(desk: Desk) -> None:
    answer = raw(desk, b"x" * (control.REQUEST_MAX + 2))
    assert not answer or b"longer than" in answer  # the kernel may throw the answer away with what was not read
    assert call(desk.server.path, {"verb": "echo"})["exit_code"] == 0


def test_client_that_never_reads_does_not_hold_up_the_loop(desk: Desk) -> None:
    with socket.socket(socket.AF_UNIX) as idle, socket.socket(socket.AF_UNIX) as mute:
        mute.connect(str(desk.server.path))
        idle.connect(str(desk.server.path))
        idle.sendall(b'{"verb": "flood"}\n')
        before = desk.turns
        assert call(desk.server.path, {"verb": "echo"})["exit_code"] == 0
        while desk.turns < before + 5:
            time.sleep(0.01)


def test_client_that_sends_no_request_is_dropped_in_time(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "REQUEST_WITHIN_NS", 50_000_000)
    assert raw(desk, b'{"verb"') == b""


def test_client_that_hangs_up_is_noticed(desk: Desk) -> None:
    with socket.socket(socket.AF_UNIX) as sock:
        sock.connect(str(desk.server.path))
        sock.sendall(b'{"verb": "wait"}\n')
        while not desk.waiting:
            time.sleep(0.005)
    while not desk.waiting[0].gone:
        time.sleep(0.005)
    desk.waiting[0].progress(text="into the void")
    desk.waiting[0].answer(0, "nobody hears it")
    assert call(desk.server.path, {"verb": "echo"})["exit_code"] == 0  # and the next one is served


def test_more_clients_than_allowed_are_sent_away(desk: Desk) -> None:
    with contextlib.ExitStack() as stack:
        socks = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(control.CLIENTS_MAX + 1)]
        for sock in socks:
            sock.connect(str(desk.server.path))
        socks[-1].settimeout(10.0)
        assert b"too many" in socks[-1].recv(1000)


def test_running_daemon_is_found_by_name_and_alone(desk: Desk, tmp_path: Path) -> None:
    assert find_socket() == desk.server.path
    assert find_socket("rover") == desk.server.path
    assert find_socket("other", required=False) is None
    with pytest.raises(UsageError, match="no daemon of robot 'other' is running here"):
        find_socket("other")
    second = Desk(desk.server.path.with_name("walker.sock"))
    try:
        with pytest.raises(UsageError, match="several daemons run here: rover, walker; choose one with --robot"):
            find_socket()
    finally:
        second.close()


def test_second_daemon_of_a_robot_is_refused_and_a_stale_socket_is_not_one(desk: Desk, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="already running"):
        ControlServer(desk.server.path, desk.selector, desk.on_request).open()
    stale = desk.server.path.with_name("gone.sock")
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(stale))
    assert find_socket() == desk.server.path
    revived = Desk(stale)
    assert call(stale, {"verb": "echo"})["exit_code"] == 0
    revived.close()
    assert not stale.exists()


def test_no_daemon_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with pytest.raises(UsageError, match=r"no daemon is running here .*; start one: s2r run PROFILE"):
        find_socket()
    with pytest.raises(UsageError, match="no daemon answers"):
        call(tmp_path / "none.sock", {"verb": "status"})


def test_socket_path_that_is_too_long_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 107 bytes; set XDG_RUNTIME_DIR"):
        ControlServer(tmp_path / ("x" * 120) / "r.sock", selectors.DefaultSelector(), lambda c, r: None).open()


def test_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give a folder away")
    folder = tmp_path / "theirs"
    folder.mkdir()
    os.chown(folder, 12345, -1)
    with pytest.raises(ConfigError, match="belongs to user 12345"):
        ControlServer(folder / "r.sock", selectors.DefaultSelector(), lambda c, r: None).open()


def test_another_user_is_not_heard_even_where_the_files_modes_would_let_him(desk: Desk) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can be somebody else")
    for path in (desk.server.path, *desk.server.path.parents):
        if path in (Path("/"), Path("/tmp")):
            break
        path.chmod(0o777)
    program = f"import socket; s = socket.socket(socket.AF_UNIX); s.connect({str(desk.server.path)!r}); print(s.recv(1000).decode())"
    heard = subprocess.run(["/usr/bin/env", "python3", "-c", program], user=65534, capture_output=True, text=True, check=True, cwd="/")
    assert "user 65534 may not talk to this daemon" in heard.stdout


# ---------------------------------------------------------------- systemd


def test_notifier_says_ready_alive_status_and_stopping(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(5.0)
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())})
        notifier.ready("gate closed")
        notifier.alive(10_000_000_000)
        notifier.alive(10_500_000_000)  # half a period has not passed
        notifier.alive(11_000_000_000)
        notifier.status("gate open")
        notifier.status("gate open")
        notifier.stopping()
        notifier.close()
        notifier.close()
        said = [manager.recv(1000).decode() for _ in range(5)]
        assert said == ["READY=1\nSTATUS=gate closed", "WATCHDOG=1", "WATCHDOG=1", "STATUS=gate open", "STOPPING=1"]


def test_notifier_without_a_manager_does_nothing(tmp_path: Path) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "nobody")}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}):
        notifier = Notifier(environment)
        assert notifier.watchdog_ns == 0
        notifier.ready()
        notifier.alive(1)
        notifier.close()


def test_service_unit_calls_what_the_command_line_knows_and_waits_for_readiness() -> None:
    from s2r_runtime.cli.main import parser

    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(Path(__file__).parent.parent / "tools" / "s2r.service")
    service = unit["Service"]
    program, *arguments = service["ExecStart"].split()
    args = parser().parse_args(arguments)
    assert (Path(program).name, args.verb, args.state) == ("s2r", "run", Path("/var/lib/s2r"))
    assert (service["Type"], service["KillMode"], service["RestartPreventExitStatus"]) == ("notify", "mixed", "2 78")
    assert float(service["WatchdogSec"]) > 0


SOMEBODY_LISTENS = """
import os, socket, sys
s = socket.socket(socket.AF_UNIX)
os.setuid(12345)
s.bind(sys.argv[1]); os.chmod(sys.argv[1], 0o777); s.listen()
print("listening", flush=True)
c, _ = s.accept()
print(c.recv(1000).decode(), flush=True)
"""
CALLS = """
import os, sys
from pathlib import Path
from s2r_runtime.daemon import control
os.setuid(int(sys.argv[2]))
try:
    print(control.call(Path(sys.argv[1]), {"verb": "stop"}))
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be two other people")
@pytest.mark.parametrize("caller", [65534, 0])
def test_a_client_says_nothing_to_a_third_user_who_listens_in_the_daemons_place(caller: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)  # somebody else is to put his socket there
        path = f"{name}/rover.sock"
        theirs = subprocess.Popen([sys.executable, "-c", SOMEBODY_LISTENS, path], stdout=subprocess.PIPE, text=True)
        assert theirs.stdout is not None
        assert theirs.stdout.readline() == "listening\n"
        said = subprocess.run([sys.executable, "-c", CALLS, path, str(caller)], capture_output=True, text=True, check=True)
        assert "UsageError" in said.stdout
        assert "whoever listens there is user 12345, and no daemon of yours" in said.stdout
        assert theirs.stdout.read().strip() == ""
        theirs.wait(30)
        theirs.stdout.close()


@pytest.mark.parametrize(
    ("request_line", "words"),
    [
        (b'{"verb": "clear", "text": "\\udcff"}', "surrogate"),
        (b'{"verb": "clear", "text": "a\\u0000b"}', "cannot be printed"),
        (b'{"verb": "clear", "text": "' + b"x" * 201 + b'"}', "longer than 200 bytes"),
        (b'{"verb": "deploy", "path": "\xff"}', "UTF-8"),
        (b'{"verb": "permit", "duration_s": ' + b"9" * 10_000 + b"}", "must be >= 0 and finite"),
        (b'{"verb": "adopt", "text": ' + b"[" * 100_000 + b"}", "not understood"),
    ],
)
def test_a_strange_field_is_refused_in_one_printable_line_at_the_door(desk: Desk, request_line: bytes, words: str) -> None:
    answer = json.loads(raw(desk, request_line + b"\n").splitlines()[-1])
    assert answer["exit_code"] in (2, 78)
    assert words in answer["text"]
    assert answer["text"].isprintable()


def test_a_client_says_which_field_is_no_text_before_anything_is_sent(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="deploy: path is not UTF-8 text"):
        call(tmp_path / "nobody.sock", {"verb": "deploy", "path": "/robots/caf\udce9/c.py"})
