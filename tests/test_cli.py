"""The command line as a person meets it: exit codes, one clear line for every mistake, never a traceback."""

from __future__ import annotations

import errno
import gzip
import json
import os
import shlex
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from command_reference import verbs

from s2r_runtime.api.files import writable
from s2r_runtime.cli import output
from s2r_runtime.cli.main import main, parser
from s2r_runtime.cli.verbs import VERBS
from s2r_runtime.errors import UsageError
from s2r_runtime.files import durable
from s2r_runtime.trust.offline_ledger import open_ledger

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "profiles" / "robotarium.toml"
GRID = ROOT / "controllers" / "grid.py"


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


@pytest.mark.slow
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
        (lambda t: t.replace("theta", "facing"), 2, ("theta", "column")),
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
        (("verify", str(GRID), "--profile", str(PROFILE), "--radius", "1", "--param", "maargin=1"), 2, ("--param", "'maargin'")),
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


@pytest.mark.slow
def test_every_verb_has_help() -> None:
    done = s2r("--help")
    assert done.returncode == 0
    verbs = "demo run sample gap trace verify certify deploy undeploy revoke adopt clear stop permit status"
    verbs += " audit report log plugin profile keys doctor"
    for verb in verbs.split():
        assert f"  {verb} " in done.stdout
        assert s2r(verb, "--help").returncode == 0


@pytest.mark.parametrize("argv", [["--help"], ["--version"], ["trace", "--help"]])
def test_what_is_only_shown_loads_no_numerics(argv: list[str]) -> None:
    code = "import sys; from s2r_runtime.cli.main import main\ntry: main(sys.argv[1:])\nfinally: print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "False", done


@pytest.mark.parametrize(
    "option", [["--epsilon", "0_1.0"], ["--dt", "1_0"], ["--param", "wheel_base=1_0"], ["--seed", "1_0"], ["--seed", "\u0663"]]
)
def test_a_number_is_what_every_language_reads_as_one(option: list[str]) -> None:
    verb = ["gap", "run.csv", "--model", "bicycle"] if option[0] == "--epsilon" else ["trace", "run.csv", "--model", "bicycle"]
    refused(s2r(*verb, *(() if option[0] == "--dt" else ("--dt", "0.1")), *option), 2, option[1].rpartition("=")[2])


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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("option", ["-o", "--report"])
def test_trace_checks_where_its_output_goes_before_it_works(table: Path, tmp_path: Path, option: str) -> None:
    refused(s2r("trace", table, *MODEL, option, tmp_path / "none" / "a.toml"), 2, "a.toml", "no folder")
    refused(s2r("trace", table, *MODEL, option, tmp_path), 2, "is a folder")
    refused(s2r("trace", "--live", "campaign", option, tmp_path), 2, "is a folder")


@pytest.mark.slow
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


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A unicycle that turns at 80 % of what is commanded, 25 s at 10 Hz."""
    rng, x, rows = np.random.default_rng(1), np.zeros(3), ["t,x,y,theta,v,w"]
    for k in range(250):
        u = rng.uniform([-0.2, -1.5], [0.4, 1.5]) if k % 8 == 0 else u  # noqa: F821 - of the row before
        rows.append(",".join(f"{value:.6f}" for value in (0.1 * k, *(x + rng.normal(0.0, [1e-3, 1e-3, 3e-3])), *u)))
        x = x + 0.1 * np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), 0.8 * u[1]])
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("option", ["-o", "--report", "--suggest"])
def test_no_output_of_a_trace_takes_the_place_of_what_it_reads(drive: Path, tmp_path: Path, option: str) -> None:
    before, link = drive.read_bytes(), tmp_path / "link.csv"
    link.symlink_to(drive)
    refused(s2r("trace", drive, *MODEL, option, drive), 2, option, "is the recording")
    refused(s2r("trace", drive, *MODEL, option, link), 2, option, "is the recording")
    model = tmp_path / "model.toml"
    model.write_text('[model]\nname = "unicycle"\ndt = 0.1\n')
    refused(s2r("trace", drive, "--model", model, option, model), 2, option, "is the model")
    assert drive.read_bytes() == before


def test_outputs_do_not_take_each_others_place(drive: Path, tmp_path: Path) -> None:
    refused(s2r("trace", drive, *MODEL, "-o", tmp_path / "a", "--report", tmp_path / "a"), 2, "--report", "is the file of -o")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("verb", [("report",), ("log", "recover")])
def test_no_output_takes_the_place_of_a_log(table: Path, verb: tuple[str, ...]) -> None:
    refused(s2r(*verb, table, "-o", table), 2, "is the log")
    assert table.read_text().startswith("segment,t")


def test_no_output_takes_the_place_of_a_controller(table: Path, tmp_path: Path) -> None:
    controller = tmp_path / "grid.py"
    controller.write_bytes((ROOT / "controllers" / "grid.py").read_bytes())
    given = (controller, "--profile", PROFILE, "--recording", table, "-o", controller)
    refused(s2r("certify", *given), 2, "is the controller")
    refused(s2r("synthesize", *given), 2, "is the controller")


def test_no_output_takes_the_place_of_the_file_behind_a_model(drive: Path, tmp_path: Path) -> None:
    own, model = tmp_path / "own.py", tmp_path / "model.toml"
    names = 'STATES = ("x", "y", "theta")\nINPUTS = ("v", "w")\nPARAMS = {}\nANGLES = ("theta",)\n'
    text = names + "\n\ndef step(x, u, dt, params):\n    return x\n"
    own.write_text(text)
    model.write_text(f'[model]\nname = "{own}"\ndt = 0.1\n')
    refused(s2r("trace", drive, "--model", model, "-o", own), 2, "is the model's file")
    assert own.read_text() == text


@pytest.mark.slow
def test_a_model_may_be_written_into_a_pipe(drive: Path) -> None:
    done = piped("{} | cat", "trace", drive, *MODEL, "-o", "/dev/stdout")
    assert "[model]" in done.stdout, done.stderr


def test_a_file_that_cannot_be_written_leaves_what_was_there_and_loses_no_result(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "model.toml"
    old.write_text("precious")

    def full(self: Path, *_: object, **__: object) -> int:
        self.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    assert main(["trace", str(drive), *MODEL, "-o", str(old)]) == 2
    told = capsys.readouterr()
    assert "input_gain on w" in told.out
    assert "written to" not in told.out
    assert told.err.splitlines()[-1] == f"s2r: {old}: cannot be written: No space left on device"
    assert old.read_text() == "precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.csv", "model.toml"]


@pytest.mark.slow
def test_a_certificate_that_cannot_be_written_tells_what_the_spent_attempt_showed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign, key = tmp_path / "campaign.csv", tmp_path / "key.pem"
    # a command of the profile acts a period late
    rng, lines = np.random.default_rng(2), ["segment,t,x,y,theta,v,w"]
    for i, v in enumerate(rng.uniform(0.0, 0.2, 200)):
        lines += [f"{i},{0.033 * k:.3f},{0.033 * max(k - 1, 0) * v + rng.normal(0.0, 1e-6):.9f},0,0,{v:.9f},0" for k in range(3)]
    campaign.write_text("\n".join(lines) + "\n")
    assert main(["keys", "new", str(key)]) == 0
    capsys.readouterr()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(durable, "replace", full)
    given = ("certify", ROOT / "controllers" / "grid.py", "--profile", PROFILE, "--recording", campaign, "--key", key)
    assert main([*map(str, given), "-o", str(tmp_path / "a.cert"), "--json"]) == 2
    told = capsys.readouterr()
    answer = json.loads(told.out)
    assert (answer["passed"], answer["certificate"], answer["attempt"]) == (True, None, 1)
    assert told.err == f"s2r: {tmp_path / 'a.cert'}: cannot be written: No space left on device\n"


def test_a_file_that_is_written_anew_keeps_its_mode_and_a_device_is_written_to(tmp_path: Path) -> None:
    old = tmp_path / "old.html"
    old.write_text("old")
    old.chmod(0o640)
    output.write(old, "new")
    assert (old.read_text(), old.stat().st_mode & 0o777) == ("new", 0o640)
    output.write(Path(os.devnull), "gone")
    assert not Path(os.devnull).is_file()


def piped(code: str, *argv: str | Path) -> subprocess.CompletedProcess[str]:
    """s2r in a shell, as `code` says; stdout buffered as it is by default."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = shlex.join([sys.executable, "-m", "s2r_runtime", *map(str, argv)])
    return subprocess.run(["bash", "-c", code.format(command)], capture_output=True, text=True, timeout=100, check=False, env=environment)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["{} | true; exit ${{PIPESTATUS[0]}}", "{} >&-", "{} 2>&- >/dev/null"])
def test_who_does_not_listen_changes_no_exit_code(table: Path, how: str) -> None:
    few = table.with_name("few.csv")
    few.write_text("\n".join(table.read_text().splitlines()[:300]))
    for argv, code in ((("gap", table, *MODEL), 0), (("gap", few, *MODEL), 3), (("--help",), 0)):
        done = piped(how, *argv)
        assert done.returncode == code, (argv, done.stderr)
        assert all(line.startswith("s2r: ") for line in done.stderr.splitlines() if argv != ("--help",)), done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("options", [(), ("--json",)])
def test_a_result_that_nobody_gets_is_no_success(table: Path, options: tuple[str, ...]) -> None:
    refused(piped("{} >/dev/full", "gap", table, *MODEL, *options), 2, "cannot be written to stdout: No space left on device")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('ANGLES = ("theta",)', 'ANGLES = ("psi",)', ("ANGLES names 'psi'", "x, y, theta")),
        ('("x", "y", "theta")', '("x", "x", "theta")', ("'x' stands 2 times", "must stand there once")),
        ('("v", "w")', '("x", "w")', ("'x' stands 2 times in STATES and INPUTS",)),
        ('("x", "y", "theta")', '("t", "y", "theta")', ("'t' is no name for a state",)),
        ('("v", "w")', '("v", "segment")', ("'segment' is no name",)),
        ('("v", "w")', "()", ("INPUTS is empty",)),
        ('("x", "y", "theta")\nINPUTS', "()\nINPUTS", ("STATES is empty",)),
        ("{}", '{"k": float("nan")}', ("PARAMS has k = nan", "finite")),
        ("return x + 0.0", "return x + 1j", ("complex",)),
    ],
)
@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_a_model_file_that_cannot_be_meant_is_one_line(
    drive: Path, tmp_path: Path, verb: str, old: str, new: str, words: tuple[str, ...]
) -> None:
    names = 'STATES = ("x", "y", "theta")\nINPUTS = ("v", "w")\nPARAMS = {}\nANGLES = ("theta",)\n'
    text = names + "\ndef step(x, u, dt, params):\n    return x + 0.0\n"
    assert old in text
    model = tmp_path / "model.py"
    model.write_text(text.replace(old, new))
    refused(s2r(verb, drive, "--model", model, "--dt", "0.1"), 78, "model.py", *words)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (("gap", "--dt", "1e-9"), 2, ("comes every 0.1 s", "1e-09 s")),
        (("trace", "--dt", "1e9"), 2, ("no two rows", "1e+09 s", "24.9 s")),
        (("gap", "--dt", "0.1", "--weight", "theta=1e300"), 2, ("--weight theta=1e300", "1e-30 to 1e+30")),
        (("trace", "--dt", "0.1", "--horizon", "0.01"), 2, ("--horizon 0.01", "the model's step, 0.1 s")),
        (("trace", "--dt", "nan"), 2, ("--dt", "nan must be > 0 and finite")),
        (("gap", "--dt", "fast"), 2, ("--dt", "'fast' is not a number")),
        (("gap", "--dt", "0.1", "--weight", "x=nan"), 2, ("--weight x=nan", "NAME=NUMBER, finite")),
        (("gap", "--dt", "0.1", "--param", "mas=1"), 2, ("--param mas", "no such parameter")),
        (("trace", "--dt", "0.1", "--suggest", "s.csv", "--suggest-duration", "1e9"), 2, ("--suggest-duration 1e+09", "10000 s")),
    ],
)
def test_a_number_out_of_all_bounds_is_one_line(drive: Path, argv: tuple[str, ...], code: int, words: tuple[str, ...]) -> None:
    refused(s2r(argv[0], drive, "--model", "unicycle", *argv[1:], cwd=drive.parent), code, *words)


def test_a_radius_may_be_zero_and_what_is_said_of_others_allows_for_that() -> None:
    done = s2r("verify", ROOT / "controllers" / "grid.py", "--profile", PROFILE, "--radius", "-1")
    refused(done, 2, "--radius", "-1 must be >= 0 and finite")


def test_stamps_that_tell_no_step_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "late.csv"
    path.write_text("t,x,y,theta,v,w\n" + "".join(f"{10**18 + 200 * k},0,0,0,0.1,0\n" for k in range(100)))
    refused(s2r("gap", path, *MODEL), 2, "has a stamp of 1e+18 s", "t_ns")
    path.write_text("t,x,y,theta,v,w\n" + "".join(f"5,{k},0,0,0.1,0\n" for k in range(100)))
    refused(s2r("gap", path, *MODEL), 3, "holds no transition")


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


@pytest.mark.parametrize(
    ("argv", "wrong", "right"),
    [
        (["smaple"], "'smaple'", "did you mean sample?"),
        (["gap", "run.csv", "--modle", "unicycle"], "'--modle'", "did you mean --model?"),
        (["log", "inof"], "'inof'", "did you mean info?"),
        (["xyzzy"], "'xyzzy'", "it can be demo, run,"),
    ],
)
def test_what_is_mistyped_gets_the_nearest_name(argv: list[str], wrong: str, right: str) -> None:
    refused(s2r(*argv), 2, wrong, right)


def test_the_table_of_verbs_is_the_command_line() -> None:
    assert {name.split()[1] for name, _, _ in verbs(parser(), "s2r")} == set(VERBS)
