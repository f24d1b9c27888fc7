"""The command line as a person meets it: exit codes, one clear line for every mistake, never a traceback."""

from __future__ import annotations

import gzip
import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_reference import verbs

from s2r_runtime.cli.choices import writable
from s2r_runtime.cli.main import parser
from s2r_runtime.errors import UsageError
from s2r_runtime.offline_ledger import open_ledger

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "profiles" / "robotarium.toml"


def s2r(*argv: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "s2r_runtime", *map(str, argv)], capture_output=True, text=True, timeout=100, check=False, cwd=cwd
    )


def refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line on stderr, that code, those words, nothing on stdout."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert done.stdout == ""
    for word in words:
        assert word in done.stderr


def holds(n: int, *, radius: float = 0.001) -> str:
    """A table of n held inputs, three rows each, 0.1 s apart, on which an Euler unicycle is off by `radius` in x."""
    lines = ["segment,t,x,y,theta,v,w"]
    for i in range(n):
        off = radius * (i + 1) / n
        lines += [f"{i},{0.1 * k:.1f},{0.1 * k * 0.2 + (off if k else 0.0)!r},0,0,0.2,0" for k in range(3)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "holds.csv"
    path.write_text(holds(299))
    return path


MODEL = ("--model", "unicycle", "--dt", "0.1")


def test_gap_of_a_table_is_the_largest_discrepancy(table: Path) -> None:
    done = s2r("gap", table, *MODEL, "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["radius"] == pytest.approx(0.001)
    assert answer["radius_literal"] == pytest.approx(0.001)
    assert (answer["n"], answer["discarded"], answer["epsilon"], answer["beta"], answer["set"]) == (299, 0, 0.01, 0.05, "ball")
    assert answer["independent"] is True
    assert "0.01" in answer["statement"] or "1 %" in answer["statement"]


def test_gzip_tells_the_same(table: Path, tmp_path: Path) -> None:
    packed = tmp_path / "holds.csv.gz"
    packed.write_bytes(gzip.compress(table.read_bytes()))
    assert json.loads(s2r("gap", packed, *MODEL, "--json").stdout)["radius"] == pytest.approx(0.001)


def test_too_few_samples_say_how_many_more(tmp_path: Path) -> None:
    path = tmp_path / "few.csv"
    path.write_text(holds(290))
    done = s2r("gap", path, *MODEL)
    assert done.returncode == 3
    assert "9 more" in done.stderr
    answer = json.loads(s2r("gap", path, *MODEL, "--json").stdout)
    assert answer["missing_samples"] == 9


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda t: t.replace("theta", "yaw"), 2, ("theta", "column")),
        (lambda t: t.replace("\n5,0.1,", "\n5,0.1,abc", 1), 2, ("line 18", "abc")),
        (lambda t: t.replace("\n5,0.1,", "\n5,0.1,nan#", 1).replace("nan#0.021672240802675585", "nan"), 2, ("line 18",)),
        (lambda t: t.replace("\n5,0.2,", "\n5,0.05,", 1), 2, ("line 19", "backwards")),
        (lambda t: "", 2, ("empty",)),
    ],
)
def test_a_bad_recording_is_one_line_with_its_place(table: Path, change: object, code: int, words: tuple[str, ...]) -> None:
    table.write_text(change(table.read_text()))  # type: ignore[operator]
    refused(s2r("gap", table, *MODEL), code, table.name, *words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("dt = 0.033 ", "dt = -0.033 ", ("model.dt", "-0.033", "> 0")),
        ("dt = 0.033 ", 'dt = "fast" ', ("model.dt", "'fast'", "float")),
        ('name = "unicycle"', 'name = "unicyle"', ("model", "unicycle")),
        ('name = "zenoh"', 'name = "zenho"', ("transport", "zenoh")),
        ('name = "zenoh"', 'name = "robotarium"', ("transport", "s2r-standins")),
        ("[guarantee]", "[guarantees]", ("guarantees", "guarantee")),
        ("epsilon = 0.03", "epsilon = 3", ("epsilon", "between 0 and 1")),
        ("x = [-1.6, 1.6]", "x = [1.6, -1.6]", ("region.x", "low < high")),
        ("weights = { theta = 0.0525 }", "weights = { yaw = 0.0525 }", ("norm.weights.yaw", "theta")),
        ("[model]", "[model", ("TOML",)),
    ],
)
def test_a_bad_profile_is_one_line_that_says_what_would_be_right(tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    text = PROFILE.read_text()
    assert old in text
    path = tmp_path / "robot.toml"
    path.write_text(text.replace(old, new, 1))
    refused(s2r("profile", "check", path), 78, "robot.toml", *words)


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        ((), 2, ("VERB",)),
        (("gpa",), 2, ("gpa",)),
        (("gap",), 2, ("RECORDING",)),
        (("gap", "no.csv", *MODEL), 2, ("no.csv",)),
        (("gap", "no.csv"), 2, ("--profile",)),
        (("gap", "no.csv", "--model", "unicycle"), 2, ("--dt",)),
        (("gap", "no.csv", "--model", "unicycle", "--dt", "-1"), 2, ("dt",)),
        (("gap", "no.csv", *MODEL, "--epsilon", "2"), 2, ("between 0 and 1",)),
        (("audit", "no.mcap"), 2, ("no.mcap",)),
        (("verify", "no.py", "--profile", str(PROFILE), "--radius", "0.01"), 2, ("no.py",)),
        (("status", "--robot", "nobody"), 2, ("nobody",)),
        (("profile", "check", "no.toml"), 78, ("no.toml",)),
    ],
)
def test_a_wrong_call_is_one_line(argv: tuple[str, ...], code: int, words: tuple[str, ...], tmp_path: Path) -> None:
    refused(s2r(*argv, cwd=tmp_path), code, *words)


def test_json_errors_are_one_object(tmp_path: Path) -> None:
    done = s2r("gap", "no.csv", *MODEL, "--json", cwd=tmp_path)
    assert done.returncode == 2
    assert json.loads(done.stdout)["exit_code"] == 2


def test_every_verb_has_help() -> None:
    done = s2r("--help")
    assert done.returncode == 0
    verbs = "demo run sample gap trace verify certify deploy undeploy revoke adopt clear stop permit status"
    verbs += " audit report log plugin profile keys doctor"
    for verb in verbs.split():
        assert f"  {verb} " in done.stdout
        assert s2r(verb, "--help").returncode == 0


def test_every_verb_and_every_option_is_explained_where_it_is_asked_for() -> None:
    pages = [(name, verb) for name, verb, _ in verbs(parser(), "s2r")]
    assert len(pages) > 25
    assert [name for name, verb in pages if not verb.description] == []
    assert [(name, one.dest) for name, verb in pages for one in verb._actions if not one.help] == []


def test_keys_are_private_and_never_overwritten(tmp_path: Path) -> None:
    key = tmp_path / "key.pem"
    assert s2r("keys", "new", key).returncode == 0
    assert key.stat().st_mode & 0o077 == 0
    before = key.read_bytes()
    refused(s2r("keys", "new", key), 78, "key.pem")
    assert key.read_bytes() == before


def test_doctor_and_plugins_say_what_is_here() -> None:
    assert json.loads(s2r("doctor", "--json").stdout)["ok"] is True
    listed = json.loads(s2r("plugin", "list", "--json").stdout)["plugins"]
    assert {p["name"] for p in listed} >= {"builtin", "zenoh", "standins"}


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import os\ndef control(x, theta, parameters):\n    os._exit(0)\n", "died"),
        ("def control(x, theta, parameters):\n    while True:\n        pass\n", "not done within"),
        ("def control(x, theta, parameters):\n    raise KeyError('gain')\n", "KeyError"),
        ("def control(x, theta, parameters):\n    return x[:, :1]\n", "shape"),
        ("import numpy as np\ndef control(x, theta, parameters):\n    return np.full((len(x), 2), np.nan)\n", "finite"),
        ("import numpy as np\ndef control(x, theta, parameters):\n    return np.zeros((len(x), 2))\n", "under uniform"),
    ],
)
def test_a_controller_that_fails_never_passes(tmp_path: Path, code: str, reason: str) -> None:
    controller, profile = tmp_path / "bad.py", tmp_path / "robot.toml"
    controller.write_text(code)
    timeout = 4.0 if "while True" in code else 60.0
    profile.write_text(PROFILE.read_text().replace("[verification]", f"[verification]\ntimeout = {timeout}"))
    done = s2r("verify", controller, "--profile", profile, "--radius", "0.0015", "--hold-radius", "0.002", "--json")
    assert done.returncode == 1, done.stderr
    answer = json.loads(done.stdout)
    assert answer["passed"] is False
    assert reason in answer["reason"]


@pytest.mark.parametrize("option", ["-o", "--report"])
def test_trace_checks_where_its_output_goes_before_it_works(table: Path, tmp_path: Path, option: str) -> None:
    refused(s2r("trace", table, *MODEL, option, tmp_path / "none" / "a.toml"), 2, "a.toml", "no folder")
    refused(s2r("trace", table, *MODEL, option, tmp_path), 2, "is a folder")
    refused(s2r("trace", "--live", "campaign", option, tmp_path), 2, "is a folder")


@pytest.mark.parametrize("verb", [("report",), ("log", "recover")])
def test_verbs_about_logs_check_where_their_output_goes_before_they_work(table: Path, tmp_path: Path, verb: tuple[str, ...]) -> None:
    refused(s2r(*verb, table, "-o", tmp_path / "none" / "a.out"), 2, "a.out", "no folder")
    refused(s2r(*verb, table, "-o", tmp_path), 2, "is a folder")


def test_certify_checks_where_its_certificate_goes_before_it_pays(table: Path, tmp_path: Path) -> None:
    key = tmp_path / "key.pem"
    assert s2r("keys", "new", key).returncode == 0
    given = ("certify", ROOT / "controllers" / "grid.py", "--profile", PROFILE, "--recording", table, "--key", key)
    refused(s2r(*given, "-o", tmp_path / "none" / "a.cert"), 2, "a.cert", "no folder")
    assert open_ledger(key, "robotarium").entries() == ()


def test_what_is_put_in_a_files_place_needs_the_folder_and_not_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = tmp_path / "a.cert"
    there.touch()
    monkeypatch.setattr("os.access", lambda path, _mode: path == there)  # for root, everything is writable
    writable(there)
    with pytest.raises(UsageError, match=r"a\.cert: cannot be written: permission denied"):
        writable(there, replaced=True)
    monkeypatch.setattr("os.access", lambda path, _mode: path == tmp_path)
    writable(there, replaced=True)


def test_a_socket_where_nobody_listens_is_told_in_words(tmp_path: Path) -> None:
    done = s2r("status", "--socket", tmp_path / "none.sock")
    refused(done, 2, "none.sock: no daemon answers: No such file or directory")
    assert "Errno" not in done.stderr


def test_what_the_daemon_refuses_is_told_as_the_programs_own_errors_are(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()

        def answer() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(b'{"exit_code": 1, "text": "nothing drives"}\n')

        thread = threading.Thread(target=answer)
        thread.start()
        done = s2r("undeploy", "--socket", path)
        thread.join()
    refused(done, 1)
    assert done.stderr == "s2r: nothing drives\n"
