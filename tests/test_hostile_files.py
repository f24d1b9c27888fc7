"""No file knocks a reader over: pipes, devices, endless files and lengths of gigabytes are one line, within seconds and little memory."""

from __future__ import annotations

import gzip
import os
import struct
import subprocess
import sys
import time
import zlib
from collections import deque
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.files import limits
from s2r_runtime.files.bounded_file import read_bounded
from s2r_runtime.files.toml_text import load_toml
from s2r_runtime.recording.layout import MAGIC, RECORD
from s2r_runtime.recording.start import FIRST, make_start
from s2r_runtime.recordings.formats.sizes import check_size, check_values, content_of

ROOT = Path(__file__).parent.parent
PROFILE, GRID = ROOT / "profiles" / "robotarium.toml", ROOT / "controllers" / "grid.py"
SECONDS, MEMORY = 10.0, 300 << 20
"""Measured within 3 s on an idle machine; the tests share theirs."""
CLAIM, GIGABYTES = 20_000_000_000, 1 << 30
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


def packed(kind: str, path: Path) -> Path:
    """Some hundred kB that hold gigabytes of zeros, or say so."""
    if kind == "mat":
        packer = zlib.compressobj(9)
        head = struct.pack("<II", 14, 48 + 8 + GIGABYTES) + struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, GIGABYTES // 8, 1)
        data = packer.compress(head + struct.pack("<III", 1 | 1 << 16, ord("x"), 9) + struct.pack("<I", GIGABYTES))
        data += b"".join(packer.compress(bytes(1 << 24)) for _ in range(GIGABYTES >> 24)) + packer.flush()
        path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49) + struct.pack("<II", 15, len(data)) + data)
    elif kind == "parquet":
        table = pa.table({name: pa.array(np.zeros(10_000_000)) for name in "txy"})
        pq.write_table(table, path, compression="zstd", row_group_size=1 << 20)
    elif kind.startswith("mf4"):
        small = mdf_of(np.arange(64) * 0.1, path) if kind == "mf4 that lies" else mdf_of(np.zeros(20_000_000), path)
        if kind == "mf4 that lies":  # its only block unpacks to what no other claim in the file says
            old = small.find(b"##DZ")
            data = b"##DZ" + bytes(4)
            packer = zlib.compressobj(9)
            content = b"".join(packer.compress(bytes(1 << 24)) for _ in range(GIGABYTES >> 24)) + packer.flush()
            data += struct.pack("<QQ", 48 + len(content), 0) + b"DT\0\0" + struct.pack("<IQQ", 0, 1024, len(content)) + content
            small += bytes(-len(small) % 8)
            path.write_bytes(small.replace(struct.pack("<Q", old), struct.pack("<Q", len(small))) + data)
    elif kind == "page that lies":
        packed("page", path)
        path.write_bytes(smaller(path.read_bytes(), 400_000_000))
    elif kind == "page":
        table = pa.table({"t": pa.array([0.0]), "x": pa.array([0.0]), "segment": pa.array(["0" * 400_000_000])})
        pq.write_table(table, path, compression="zstd", use_dictionary=False)
    else:
        with gzip.open(path, "wb") as file:
            file.write(b"t,x,y,theta,v,w\n")
            for _ in range(64):
                file.write(b"0,0,0,0,0,0\n" * 200_000)
    return path


def mdf_of(t: np.ndarray, path: Path) -> bytes:
    """An MF4 file of one channel, its blocks packed."""
    import asammdf

    file = asammdf.MDF(version="4.10")
    file.append([asammdf.Signal(np.zeros(len(t)), t, name="x")])
    file.save(path, compression=1, overwrite=True)
    file.close()
    return path.read_bytes()


def smaller(data: bytes, least: int) -> bytes:
    """A Parquet file whose footer claims 100 bytes wherever it claimed more than `least`: varints of the same length (Thrift, zigzag)."""
    size = int.from_bytes(data[-8:-4], "little")
    footer, at = bytearray(data[-8 - size : -8]), 0
    while at + 5 <= len(footer):
        value = sum((footer[at + k] & 0x7F) << 7 * k for k in range(5))
        if all(footer[at + k] & 0x80 for k in range(4)) and not footer[at + 4] & 0x80 and 2 * least <= value < 3 * least:
            footer[at : at + 5] = bytes((0x80 | 200 & 0x7F, 0x80 | 200 >> 7, 0x80, 0x80, 0))
            at += 5
        else:
            at += 1
    return data[: -8 - size] + bytes(footer) + data[-8:]


READER = """
import sys
from pathlib import Path
from s2r_runtime.recordings.formats import isolated

header, _ = isolated._answer({"reader": sys.argv[1], "path": sys.argv[2], "name": "it", "options": {}, "wanted": None}, {})
print(header.get("error"))
print(open("/proc/self/status").read().partition("VmHWM:")[2].split()[0])
"""
"""What the process of the reader does, and its memory (kB)."""


PACKED = [("mat", "mat", "matlab"), ("parquet", "parquet", "parquet"), ("page", "parquet", "parquet"), ("mf4", "mf4", "mdf")]
LYING = [("mf4 that lies", "mf4", "mdf"), ("page that lies", "parquet", "parquet")]
"""Their tables of contents claim little; their readers may take what a file of their size can hold, and the library its own."""


@pytest.mark.parametrize(("kind", "suffix", "reader"), PACKED + LYING)
def test_what_unpacks_to_gigabytes_is_one_line_before_it_is_unpacked(tmp_path: Path, kind: str, suffix: str, reader: str) -> None:
    path = packed(kind, tmp_path / f"a.{suffix}")
    assert path.stat().st_size < 4 << 20
    assert one_line("topics", path) == 2
    assert one_line("gap", path, "--model", "unicycle", "--dt", "0.1") == 2
    alone = subprocess.run([sys.executable, "-c", READER, reader, str(path)], capture_output=True, text=True, check=True, timeout=60)
    error, peak = alone.stdout.splitlines()
    assert "S2R_MAX_RATIO" in error
    assert int(peak) << 10 < MEMORY * (2 if kind.endswith("lies") else 1)


def test_a_packed_table_that_unpacks_for_ever_is_one_line(tmp_path: Path) -> None:
    assert one_line("gap", packed("csv", tmp_path / "a.csv.gz"), "--model", "unicycle", "--dt", "0.1") == 2


def test_limits_are_settings_that_errors_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.toml"
    path.write_text("x = 1\n" + "#" * (1 << 20))
    assert load_toml(path) == {"x": 1}
    monkeypatch.setenv("S2R_MAX_TEXT_MB", "0.5")
    with pytest.raises(ConfigError, match=r"set S2R_MAX_TEXT_MB in the environment \(now 0\.5\)"):
        load_toml(path)
    monkeypatch.setenv("S2R_MAX_NUMBERS", "10")
    monkeypatch.setenv("S2R_MAX_FILE_GB", "1e-4")
    for check in (lambda: check_values(path, 11), lambda: check_size(path)):
        with pytest.raises(RecordingError, match="S2R_MAX_"):
            check()
    for wrong in ("much", "-1", "0", "nan", "inf"):
        monkeypatch.setenv("S2R_MAX_TEXT_MB", wrong)
        with pytest.raises(ConfigError, match="must be a number > 0"):
            load_toml(path)


def test_the_docs_name_every_limit_and_its_default() -> None:
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    for limit in limits.ALL:
        (row,) = [line for line in page.splitlines() if f"`{limit.name}`" in line]
        assert (f"{limit.default:g} " if limit.default < 1e6 else f"{limit.default / 1e6:g} million") in row.replace(",", " ")


def test_a_bounded_read_takes_what_fits_and_nothing_else(tmp_path: Path) -> None:
    data = Ed25519PrivateKey.generate().private_bytes_raw() * 32
    path = tmp_path / "a"
    path.write_bytes(data)
    assert read_bounded(path, len(data)) == data
    for what, most, words in ((path, len(data) - 1, "has more than"), (tmp_path, 10, "directory"), (tmp_path / "none", 10, "No such file")):
        with pytest.raises(ConfigError, match=words):
            read_bounded(what, most)


@pytest.mark.parametrize("packing", ["gz", "zstd"])
@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.tlog", "a.log"])
def test_recordings_of_plug_ins_that_unpack_for_ever_are_one_line(tmp_path: Path, name: str, packing: str) -> None:
    starts = {"a.mcap": MAGIC, "a.db3": b"SQLite format 3\0", "a.tlog": bytes(8) + b"\xfd", "a.log": b"(0.0) can0 123#00\n"}
    path = tmp_path / f"{name}.{packing}"
    with gzip.open(path, "wb") if packing == "gz" else zstandard.open(path, "wb") as file:
        file.write(starts[name])
        for _ in range(GIGABYTES >> 24):
            file.write(bytes(1 << 24))
    with content_of(path) as content, pytest.raises(RecordingError, match="S2R_MAX_RATIO"):
        deque(iter(partial(content.read, 1 << 20), b""), 0)
    assert one_line("topics", path) == 2
    assert one_line("gap", path, "--model", "unicycle", "--dt", "0.1") in (2, 3)
