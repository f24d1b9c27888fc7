"""No file knocks a reader over: pipes, devices, endless files and lengths of gigabytes are one line, within seconds and little memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.bounded_file import read_bounded
from s2r_runtime.errors import ConfigError
from s2r_runtime.recording.layout import RECORD
from s2r_runtime.recording.start import FIRST, make_start

ROOT = Path(__file__).parent.parent
PROFILE, GRID = ROOT / "profiles" / "robotarium.toml", ROOT / "controllers" / "grid.py"
SECONDS, MEMORY = 10.0, 300 << 20
"""Measured within 3 s on an idle machine; the tests share theirs."""
CLAIM = 20_000_000_000
ATTACHMENT, METADATA = 9, 12
HOSTILE = ("pipe", "zero", "large")


PROGRAM = """
import resource, sys
from s2r_runtime.cli.main import main

code = 70
try:
    code = main(sys.argv[1:])
except SystemExit as ended:
    code = ended.code
finally:
    own = int(open("/proc/self/status").read().partition("VmHWM:")[2].split()[0])
    print(f"peak {max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)}", file=sys.stderr)
sys.exit(code)
"""
"""A command that says how much memory it had (kB), and the processes that it started. Seen from here, it would have the tests' own."""


def made(kind: str, path: Path) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as file:
            file.truncate(CLAIM)
    return path


def one_line(*argv: str | Path) -> int:
    """The exit code of a command that ends in time, within the memory, with one line on stderr and no traceback."""
    began = time.monotonic()
    with subprocess.Popen([sys.executable, "-c", PROGRAM, *map(str, argv)], stdout=-1, stderr=-1, text=True) as process:
        try:
            _, err = process.communicate(timeout=6 * SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert time.monotonic() - began < SECONDS
    err, _, peak = err.rpartition("peak ")
    assert int(peak) << 10 < MEMORY
    assert len(err.strip().splitlines()) == 1, err
    assert "Traceback" not in err
    return process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTILE)
def test_profiles_and_models_of_a_hostile_kind_are_bad_configuration(tmp_path: Path, kind: str) -> None:
    toml, code = made(kind, tmp_path / "a.toml"), made(kind, tmp_path / "a.py")
    assert one_line("profile", "check", toml) == 78
    assert one_line("run", toml) == 78
    assert one_line("gap", "x.csv", "--model", toml) == 78
    assert one_line("gap", "x.csv", "--model", code, "--dt", "0.1") == 78
    assert one_line("adopt", toml) == 78


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTILE)
def test_certificates_controllers_and_logs_of_a_hostile_kind_are_refused(tmp_path: Path, kind: str) -> None:
    cert, code, log = (made(kind, tmp_path / name) for name in ("a.cert", "a.py", "a.mcap"))
    assert one_line("deploy", GRID, "--certificate", cert) == 2
    assert one_line("verify", code, "--profile", PROFILE, "--radius", "0") in (2, 78)
    assert one_line("topics", log) == 2
    for verb in (("gap", log), ("trace", log), ("trials", GRID, log)):
        assert one_line(*verb, "--profile", PROFILE) in (2, 3)


@pytest.mark.slow
@pytest.mark.parametrize("claim", ["attachment", "attachment with an end", "metadata"])
def test_lengths_that_a_log_claims_take_no_memory(tmp_path: Path, claim: str) -> None:
    path = tmp_path / "a.mcap"
    start = FIRST + RECORD.pack(METADATA, CLAIM) if claim == "metadata" else make_start({}, run="x") + RECORD.pack(ATTACHMENT, CLAIM)
    with path.open("wb") as file:
        file.write(start)
        file.truncate(CLAIM + 1000)
        if "end" in claim:
            file.seek(CLAIM + 900)
            file.write(b"x" * 100)
    assert one_line("gap", path, "--profile", PROFILE) in (2, 3)
    assert one_line("trace", path, "--profile", PROFILE) == 2
    assert one_line("trials", GRID, path, "--profile", PROFILE) in (3, 78)
    assert one_line("log", "info", path) == 2
    assert one_line("log", "recover", path, "-o", tmp_path / "b.mcap") == 2
    assert one_line("report", path, "-o", tmp_path / "a.html") == 3
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mcap"]
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", PROGRAM, "audit", str(path)], capture_output=True, text=True, timeout=60, check=False)
    assert int(done.stderr.rpartition("peak ")[2]) << 10 < MEMORY
    assert time.monotonic() - began < SECONDS


@pytest.mark.parametrize("kind", [*HOSTILE, "cut"])
def test_logs_of_a_hostile_kind_are_one_line_in_every_verb_of_logs(tmp_path: Path, kind: str) -> None:
    log = tmp_path / "a.mcap"
    if kind == "cut":
        log.write_bytes(make_start({}, run="x")[:-3])
    else:
        made(kind, log)
    for verb in (("log", "info", log), ("log", "recover", log, "-o", tmp_path / "b.mcap"), ("report", log, "-o", tmp_path / "a.html")):
        assert one_line(*verb) in (2, 3)
    assert one_line("audit", log) in (2, 3)


@pytest.mark.parametrize("kind", [*HOSTILE, "no log", "no table"])
@pytest.mark.parametrize("suffix", ["mcap", "csv"])
def test_a_recording_is_looked_at_before_it_is_digested(tmp_path: Path, kind: str, suffix: str) -> None:
    """A digest of 3 GB takes longer than one may wait."""
    key, recording = tmp_path / "key.pem", tmp_path / f"a.{suffix}"
    assert subprocess.run([sys.executable, "-m", "s2r_runtime", "keys", "new", str(key)], capture_output=True, check=False).returncode == 0
    if kind in HOSTILE:
        made(kind, recording)
    else:
        recording.write_bytes(b"t,x\n1,2\n" if kind == "no log" else b"\0")
        os.truncate(recording, 3_000_000_000)
    assert one_line("certify", GRID, "--profile", PROFILE, "--recording", recording, "-o", tmp_path / "c", "--key", key) in (2, 3)
    assert one_line("verify", GRID, "--profile", PROFILE, "--recording", recording) in (2, 3)


def test_a_bounded_read_takes_what_fits_and_nothing_else(tmp_path: Path) -> None:
    data = Ed25519PrivateKey.generate().private_bytes_raw() * 32
    path = tmp_path / "a"
    path.write_bytes(data)
    assert read_bounded(path, len(data)) == data
    for what, most, words in ((path, len(data) - 1, "has more than"), (tmp_path, 10, "directory"), (tmp_path / "none", 10, "No such file")):
        with pytest.raises(ConfigError, match=words):
            read_bounded(what, most)
