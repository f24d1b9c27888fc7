"""Recordings in other people's formats, written by their own libraries (or byte by byte, by the public description of the format).

A drive of the unicycle model, one step a row, so that what a reader makes of a file is judged by the model itself: nothing is left over.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DT = 0.1


class Drive(NamedTuple):
    """t (N,) s; columns x, y, theta, v, w, each (N,)."""

    t: Array
    columns: dict[str, Array]


def drive(seed: int, n: int = 60, start: float = 5.0) -> Drive:
    """A drive whose inputs change every few steps."""
    draw = np.random.default_rng(seed)
    v, w = (np.repeat(draw.uniform(-1.0, 1.0, n // 6 + 1), 6)[:n] for _ in range(2))
    theta = np.concatenate([[0.3], 0.3 + np.cumsum(DT * w)[:-1]])
    x = np.concatenate([[0.0], np.cumsum(DT * v * np.cos(theta))[:-1]])
    y = np.concatenate([[0.0], np.cumsum(DT * v * np.sin(theta))[:-1]])
    return Drive(start + DT * np.arange(n), {"x": x, "y": y, "theta": np.remainder(theta + np.pi, 2 * np.pi) - np.pi, "v": v, "w": w})


def _ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(path: Path, made: Drive, instances: int = 1) -> Path:
    """By docs.px4.io, "ULog File Format": definitions, subscriptions, data in the order of their stamps."""
    formats = {
        "vehicle_local_position": "uint64_t timestamp;float heading;uint8_t ok;uint8_t[3] _padding0;double x;double y;",
        "rover_command": "uint64_t timestamp;double v;float[2] setpoint;",
    }
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000), _ulog_message("B", bytes(40))]
    out += [_ulog_message("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    out += [_ulog_message("A", struct.pack("<BH", k, k) + b"vehicle_local_position") for k in range(instances)]
    out.append(_ulog_message("A", struct.pack("<BH", 0, 100) + b"rover_command"))
    c = made.columns
    for k, t in enumerate(made.t):
        us = round(t * 1e6)
        for instance in range(instances):
            body = struct.pack("<HQfB3xdd", instance, us, c["theta"][k], 1, c["x"][k] + instance, c["y"][k])
            out.append(_ulog_message("D", body))
        out.append(_ulog_message("D", struct.pack("<HQdff", 100, us, c["v"][k], 0.0, c["w"][k])))
    path.write_bytes(b"".join(out))
    return path


ULOG_SIGNALS = {"v": "rover_command.v", "w": "rover_command.setpoint[1]"}
FORMATS = {"B": "B", "n": "4s", "N": "16s", "Z": "64s", "Q": "Q", "f": "f", "c": "h", "d": "d", "b": "b"}


def dataflash(path: Path, made: Drive, instances: int = 1) -> Path:
    """By ArduPilot's libraries/AP_Logger: FMT, UNIT, MULT and FMTU messages, then data."""
    out = bytearray()

    def put(number: int, form: str, *values: Any) -> None:
        out.extend(b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(FORMATS[one] for one in form), *values))

    def describe(number: int, name: str, form: str, columns: str) -> None:
        length = 3 + struct.calcsize("<" + "".join(FORMATS[one] for one in form))
        put(128, "BBnNZ", number, length, name.encode(), form.encode(), columns.encode())

    describe(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    describe(60, "UNIT", "QbZ", "TimeUS,Id,Label")
    describe(61, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
    describe(10, "XKF1", "QBcdd", "TimeUS,C,Yaw,PN,PE")
    describe(11, "THR", "Qf", "TimeUS,DesSpeed")
    describe(12, "STER", "Qd", "TimeUS,DesTurnRate")
    for letter, label in (("s", "s"), ("#", "instance"), ("d", "deg"), ("m", "m"), ("n", "m/s"), ("k", "deg/s")):
        put(60, "QbZ", 1, ord(letter), label.encode())
    put(61, "QBNN", 2, 10, b"s#dmm", b"F----")
    put(61, "QBNN", 2, 11, b"sn", b"F-")
    put(61, "QBNN", 2, 12, b"sk", b"F-")
    c = made.columns
    for k, t in enumerate(made.t):
        us = round(t * 1e6)
        for core in range(instances):
            put(10, "QBcdd", us, core, round(float(np.degrees(c["theta"][k])) * 100), c["x"][k] + core, c["y"][k])
        put(11, "Qf", us, c["v"][k])
        put(12, "Qd", us, float(np.degrees(c["w"][k])))
    path.write_bytes(bytes(out))
    return path


def mdf(path: Path, made: Drive, version: str = "4.10") -> Path:
    """By asammdf: poses in one group, commands in another, the yaw rate in degrees a second."""
    from asammdf import MDF, Signal

    file = MDF(version=version)
    pose = [Signal(made.columns[name], made.t, name=name, unit=unit) for name, unit in (("x", "m"), ("y", "m"), ("theta", "rad"))]
    file.append(pose, acq_name="pose")
    given = [Signal(made.columns["v"], made.t, name="v", unit="m/s"), Signal(np.degrees(made.columns["w"]), made.t, name="w", unit="deg/s")]
    file.append(given, acq_name="commands")
    file.save(path, overwrite=True)
    file.close()
    return path


def parquet(path: Path, made: Drive, **more: Any) -> Path:
    """By pyarrow: a table with the model's names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"t": made.t, **made.columns, **more}), path)
    return path


def lerobot(folder: Path, drives: list[Drive], *, files: int = 2, names: bool = True) -> Path:
    """A LeRobot data set: lists for states and actions, an episode a drive, several episodes a file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    features = {"observation.state": {"names": ["x", "y", "theta"]}, "action": {"names": {"motors": ["v", "w"]}}}
    (folder / "meta" / "info.json").write_text(json.dumps({"features": features if names else {}}))
    for part in range(files):
        tables = []
        for episode, made in _share(drives, part, files):
            state = np.column_stack([made.columns[name] for name in ("x", "y", "theta")])
            action = np.column_stack([made.columns[name] for name in ("v", "w")])
            n = len(made.t)
            tables.append(
                pa.table(
                    {
                        "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 3),
                        "action": pa.array(action.tolist(), pa.list_(pa.float64())),
                        "timestamp": made.t - made.t[0],
                        "frame_index": np.arange(n),
                        "episode_index": np.full(n, episode),
                    }
                )
            )
        pq.write_table(pa.concat_tables(tables), folder / "data" / "chunk-000" / f"episode_{part:06d}.parquet")
    return folder


def _share(drives: list[Drive], part: int, files: int) -> list[tuple[int, Drive]]:
    edges = np.linspace(0, len(drives), files + 1).astype(int)
    return list(enumerate(drives))[edges[part] : edges[part + 1]]


def matlab(path: Path, made: Drive, form: str = "5", *, nested: bool = False) -> Path:
    """By scipy: vectors, or fields of a structure."""
    from scipy import io

    values = {"t": made.t, **made.columns}
    io.savemat(path, {"log": values, "note": "a drive"} if nested else values, format=form)
    return path
