"""Logs by python-can's own writers, and the forms that it does not write, give the frames that were written: none missing, none other."""

from __future__ import annotations

import gzip
import random
import struct
import zlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import pytest
from can.io.trc import TRCFileVersion
from s2r_can.kinds import KINDS
from s2r_can.logs import read_frames
from s2r_can.records import ERROR, EXTENDED, REMOTE, LogFrame
from s2r_can.tally import Tally

from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.robot_logs import readers_of

START_S = 1_700_000_000.0
MICRO = 2e-6
"""s: stamps have microseconds, and 1.7e9 s has 0.24 µs as a float."""
FD_SIZES = (0, 3, 8, 12, 20, 48, 64)


def frames(seed: int, n: int = 40, kinds: str = "") -> list[can.Message]:
    """Random frames in time. kinds: f CAN FD, r remote, e error, c several channels, beside data frames."""
    draw = random.Random(seed)
    found, t = [], START_S + draw.randrange(1000)
    for _ in range(n):
        t += round(draw.uniform(0.0005, 0.05), 6)
        kind = draw.choice("dddd" + kinds.replace("c", ""))
        extended = draw.random() < 0.5
        size = draw.choice(FD_SIZES) if kind == "f" else draw.randrange(9)
        found.append(
            can.Message(
                timestamp=t,
                arbitration_id=draw.randrange(1, 0x1FFFFFFF if extended else 0x7FF),
                is_extended_id=extended,
                is_fd=kind == "f",
                bitrate_switch=kind == "f" and draw.random() < 0.5,
                is_remote_frame=kind == "r",
                is_error_frame=kind == "e",
                dlc=size if kind != "e" else 0,
                data=draw.randbytes(size) if kind in "df" else None,
                channel=draw.randrange(2) if "c" in kinds else 0,
            )
        )
    return found


def by(writer: Any, path: Path, messages: list[can.Message], **options: Any) -> None:
    with writer(path, **options) as log:
        for message in messages:
            log.on_message_received(message)


def trc_1_0(path: Path, messages: list[can.Message]) -> None:
    with can.TRCWriter(path) as log:
        log.file_version = TRCFileVersion.V1_0
        for message in messages:
            log.on_message_received(message)


def trc(version: str, line: str, header: str) -> Any:
    """A trace of a version that python-can reads and does not write, as PEAK's description of the format has it."""

    def write(path: Path, messages: list[can.Message]) -> None:
        days = (messages[0].timestamp - datetime(1899, 12, 30, tzinfo=UTC).timestamp()) / 86400
        text = [
            f";$FILEVERSION={version}",
            f";$STARTTIME={days!r}",
            *header.split("|"),
            ";---+--   ----+----  --+--  ----+---  +  -+ -- --",
        ]
        for k, m in enumerate(messages, start=1):
            ms, name = (
                1e3 * (m.timestamp - messages[0].timestamp),
                f"{m.arbitration_id:08X}" if m.is_extended_id else f"{m.arbitration_id:04X}",
            )
            kind = ("FB" if m.bitrate_switch else "FD") if m.is_fd else "RR" if m.is_remote_frame else "DT"
            data = "RTR" if m.is_remote_frame and version < "2" else "" if m.is_remote_frame else m.data.hex(" ").upper()
            text.append(line.format(k=k, ms=ms, id=name, n=m.dlc, data=data, kind=kind))
        path.write_text("\r\n".join(text) + "\r\n", newline="")

    return write


def asc(mode: str) -> Any:
    """python-can's ASC with relative stamps, stamps from before the trigger, or a base of ten."""

    def write(path: Path, messages: list[can.Message]) -> None:
        by(can.ASCWriter, path, messages)
        text, last, shift = [], 0.0, 5.0 if mode == "negative" else 0.0
        for line in path.read_text().splitlines():
            words = line.split()
            if line.startswith("base"):
                line = "base hex  timestamps relative" if mode == "relative" else line
            elif words and words[0].replace(".", "").isdigit():
                at = float(words[0])
                line = f"{at - last if mode == 'relative' else at - shift:11.6f} " + line.split(None, 1)[1]
                last = at
            if mode == "bare" and line.startswith("internal"):
                continue
            text.append(line)
        path.write_text("\n".join(text) + "\n")

    return write


def printed(style: str) -> Any:
    """What candump prints: lib.c of can-utils, sprint_long_canframe."""

    def write(path: Path, messages: list[can.Message]) -> None:
        lines = []
        for m in messages:
            stamp = f"{m.timestamp:.6f}"
            if style == "A":
                stamp = datetime.fromtimestamp(round(m.timestamp, 6), UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
            elif style == "z":
                stamp = f"{m.timestamp - messages[0].timestamp:010.6f}"
            name = f"{m.arbitration_id:8X}".replace(" ", "0") if m.is_extended_id else f"{m.arbitration_id:03X}"
            if m.is_error_frame:
                lines.append(
                    f" ({stamp})  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n\tcontroller-problem{{rx-overflow}}\n"
                )
                continue
            size = f"[{m.dlc:02d}]" if m.is_fd else f"[{m.dlc}]"
            data = " ".join(f"{b:08b}" for b in m.data) if style == "i" else m.data.hex(" ").upper()
            if style == "S":
                data = "`".join(f"{b:02X}" for b in reversed(m.data))
            if style == "a":
                data = data.ljust(26) + "'" + "".join(chr(b) if 32 <= b < 127 else "." for b in m.data) + "'"
            extra = "RX - -  " if style == "x" else ""
            line = f" ({stamp})  can0  {extra}{name:>8}   {size}  {'remote request' if m.is_remote_frame else data}\n"
            lines.append(f"\x1b[31m{line[:-1]}\x1b[0m\n" if style == "c" else line)
        path.write_text("".join(lines))

    return write


def savvycan(style: str) -> Any:
    """As SavvyCAN exports its frames; loggers leave columns out, or write seconds and 0x."""

    def write(path: Path, messages: list[can.Message]) -> None:
        width = max(8, *(len(m.data) for m in messages))
        columns = [
            "Time Stamp",
            "ID",
            "Extended",
            *(["Dir", "Bus"] if style == "whole" else []),
            "LEN",
            *(f"D{k + 1}" for k in range(width)),
        ]
        lines = [",".join(columns)]
        for m in messages:
            stamp = f"{round(m.timestamp * 1e6)}" if style == "whole" else f"{m.timestamp:.6f}"
            name = f"{m.arbitration_id:08X}" if style == "whole" else f"0x{m.arbitration_id:x}"
            data = [f"{b:02X}" for b in m.data] + [""] * (width - len(m.data))
            side = ["Rx", str(m.channel)] if style == "whole" else []
            lines.append(",".join([stamp, name, str(m.is_extended_id).lower(), *side, str(len(m.data)), *data]))
        path.write_text("\n".join(lines) + "\n")

    return write


def line_1(rest: str) -> str:
    return "{k:>6})   {ms:10.1f}  " + rest


V2 = "{k:>7} {ms:13.3f} {kind} {bus}{id:>8} Rx {reserved}{n:<4} {data}"
FORMS: dict[str, tuple[str, Any, str, float]] = {
    "log": ("a.log", lambda p, m: by(can.CanutilsLogWriter, p, m), "frc", MICRO),
    "asc": ("a.asc", lambda p, m: by(can.ASCWriter, p, m), "frec", MICRO),
    "asc relative": ("a.asc", asc("relative"), "fre", MICRO * 40),
    "asc negative": ("a.asc", asc("negative"), "fre", MICRO),
    "asc without events line": ("a.asc", asc("bare"), "", MICRO),
    "blf": ("a.blf", lambda p, m: by(can.BLFWriter, p, m), "frec", 1.1e-3),  # python-can: the start is in ms, and may be rounded
    "csv": ("a.csv", lambda p, m: by(can.CSVWriter, p, m), "re", MICRO),
    "savvycan": ("s.csv", savvycan("whole"), "fc", MICRO),
    "savvycan of a logger": ("a.csv", savvycan("bare"), "f", MICRO),
    "sqlite": ("a.db", lambda p, m: by(can.SqliteWriter, p, m), "re", MICRO),
    "trc 2.1": ("a.trc", lambda p, m: by(can.TRCWriter, p, m), "c", 1.1e-6),
    "trc 1.0": ("a.trc", trc_1_0, "", 0.51e-3),
    "trc 1.1": ("a.trc", trc("1.1", line_1("Rx  {id:>8}  {n}  {data}"), ";   1.1"), "r", 0.051e-3),
    "trc 1.3": ("a.trc", trc("1.3", line_1("1  Rx  {id:>8}  -  {n}  {data}"), ";   1.3"), "r", 0.051e-3),
    "trc 2.0": (
        "a.trc",
        trc("2.0", "{k:>7} {ms:13.3f} {kind} {id:>8} Rx {n:<4} {data}", ";$COLUMNS=N,O,T,I,d,l,D"),
        "rf",
        1.1e-6,
    ),
    "trc 2.1 with bus": (
        "a.trc",
        trc("2.1", "{k:>7} {ms:13.3f} {kind} 2 {id:>8} Rx -  {n:<4} {data}", ";$COLUMNS=N,O,T,B,I,d,R,l,D"),
        "rf",
        1.1e-6,
    ),
    **{f"candump {style}": ("a.txt", printed(style), "r" if style in "iSa" else "fre", MICRO) for style in "AzaxciSt"},
}  # fmt: skip


def key_of(m: can.Message) -> int:
    return m.arbitration_id | (EXTENDED if m.is_extended_id else 0) | (REMOTE if m.is_remote_frame and not m.is_fd else 0)


def compare(found: list[LogFrame], messages: list[can.Message], tolerance: float) -> int:
    """Data and remote frames that differ from those that were written, by number."""
    found = [f for f in found if not f.key & ERROR]
    wanted = [m for m in messages if not m.is_error_frame]
    if len(found) != len(wanted):
        return abs(len(found) - len(wanted))
    origin = found[0].t - wanted[0].timestamp  # some formats have no date
    return sum(
        f.key != key_of(m) or f.payload != bytes(m.data or b"") or abs(f.t - m.timestamp - origin) > 2 * tolerance
        for f, m in zip(found, wanted, strict=True)
    )


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_frames_that_were_written(tmp_path: Path, form: str) -> None:
    name, write, kinds, tolerance = FORMS[form]
    for seed in range(26):
        messages = frames(seed, kinds=kinds)
        path = tmp_path / f"{seed}{name}"
        write(path, messages)
        assert sum(fits(path.read_bytes()) for fits in KINDS.values()) == 1, "its content shows which kind it is"
        tally = Tally()
        assert compare(list(read_frames(path, tally)), messages, tolerance) == 0, seed
        assert tally.odd == 0, tally.notes()
    assert len(readers_of(path)) == 1
    if not name.endswith(".db"):
        packed = tmp_path / "packed.bin"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        assert compare(list(read_frames(packed)), messages, tolerance) == 0


@pytest.mark.parametrize(
    ("name", "extra", "note"),
    [
        ("a.trc", "     99      2.000 ST  1      -      -  Rx 00 00 00 00\r\n", "left out: 1 events of the bus or the adapter"),
        ("a.trc", "     99      2.000 DT  1     02ZZ Rx -  8    00\r\n", "1 line could not be read and is left out, the first is line"),
        ("a.asc", "   9.000000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n", "left out: 1 events that are no CAN frame"),
        ("a.asc", "   9.000000 1  201             Rx   d 8 E8 FB 00\n", "1 line could not be read and is left out, the first is line"),
        ("a.asc", "   9.000000 1  201             TxRq d 1 E8\n", "left out: 1 requests to send"),
        ("s.csv", "12,1FF,false,Rx,0,2,0A,xx,,,,,,\n", "1 line could not be read and is left out, the first is line"),
        ("a.csv", "1700000099.0,0x1,0,0,0,2,====x\n", "1 line could not be read and is left out, the first is line"),
        ("a.log", "(1700000099.0) can0 12#00\n", "1 line could not be read and is left out, the first is line"),
        ("a.log", "(1700000099.0) can0 123#0011", ""),
        ("a.asc", "   9.000000 1  201             Rx   d 2 E8", "left out: 1 line that was cut at the log's end"),
    ],
)
def test_what_cannot_be_used_is_counted_and_the_rest_is_read(tmp_path: Path, name: str, extra: str, note: str) -> None:
    form = next(key for key in ("trc 2.1", "asc", "csv", "savvycan", "log") if FORMS[key][0] == name)
    messages, path, tally = frames(1), tmp_path / name, Tally()
    FORMS[form][1](path, messages)
    lines = path.read_bytes().splitlines(keepends=True)
    at = len(lines) if not extra.endswith("\n") else len(lines) - 5
    path.write_bytes(b"".join([*lines[:at], extra.encode(), *lines[at:]]))
    found = list(read_frames(path, tally))
    assert compare(found[: len(messages)], messages, MICRO) == 0
    assert note in "; ".join(tally.notes())


def test_trace_of_an_unknown_version_is_refused_and_not_read_as_another(tmp_path: Path) -> None:
    path = tmp_path / "a.trc"
    FORMS["trc 1.1"][1](path, frames(1))
    path.write_text(path.read_text().replace("=1.1", "=1.2"))
    with pytest.raises(RecordingError, match=r"is a PCAN trace of version 1\.2; 1\.0, 1\.1, 1\.3, 2\.0, 2\.1 are read"):
        list(read_frames(path))


def test_log_with_more_than_a_few_wrong_lines_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    by(can.CSVWriter, path, frames(1, 100))
    path.write_text(path.read_text() + "a,b\n" * 5)
    with pytest.raises(RecordingError, match="5 of 106 lines are no CSV lines, the first is line 102: 'a,b'"):
        list(read_frames(path))


def test_bomb_an_endless_object_and_an_endless_view_are_refused(tmp_path: Path) -> None:
    import sqlite3

    path = tmp_path / "a.blf"
    by(can.BLFWriter, path, frames(1))
    head = path.read_bytes()[:144]

    def container(data: bytes) -> bytes:
        packed = zlib.compress(data, 9)
        size = 32 + len(packed)
        return struct.pack("<4sHHII", b"LOBJ", 16, 1, size, 10) + struct.pack("<H6xL4x", 2, len(data)) + packed + b"\0" * (size % 4)

    path.write_bytes(head + container(bytes(64 << 20)))
    with pytest.raises(RecordingError, match="has a container of more than 32 MiB"):
        list(read_frames(path))
    path.write_bytes(head + container(struct.pack("<4sHHII", b"LOBJ", 16, 1, 0, 115) + bytes(64)))
    with pytest.raises(RecordingError, match="an object of 0 bytes"):
        list(read_frames(path))
    database = tmp_path / "a.db"
    with sqlite3.connect(database) as made:
        made.execute("CREATE TABLE one (arbitration_id)")
        made.execute(
            "CREATE VIEW messages AS WITH RECURSIVE c(ts, arbitration_id) AS "
            "(SELECT 1, 1 UNION ALL SELECT ts + 1, 1 FROM c) SELECT * FROM c"
        )
    with pytest.raises(RecordingError, match="has no table `messages`"):
        list(read_frames(database))


@pytest.mark.parametrize("line", [";$STARTTIME=soon", ";$FILEVERSION=2.1\n;$STARTTIME=1e99", ";$COLUMNS="])
def test_header_at_which_python_can_fails_ends_the_reading(tmp_path: Path, line: str) -> None:
    path = tmp_path / "a.trc"
    FORMS["trc 2.1"][1](path, frames(1))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([line, *(one for one in lines if not one.startswith(line.partition("=")[0]))]) + "\n")
    with pytest.raises(RecordingError, match=r"its header is wrong|are no TRC lines|is no TRC log"):
        list(read_frames(path))
