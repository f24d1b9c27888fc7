"""Long recordings: time and memory of `s2r gap` and `s2r trace`, and of what only looks like a recording (docs/recordings.md).

    python tools/bench_recordings.py             two million rows (110 MB), plain and packed
    python tools/bench_recordings.py --huge      36 million rows (2 GB of text) packed as well, in some ten minutes

Exits 1 if a limit is missed: 600 MB, and 120 s of the processor for two million rows; 300 MB and 5 s of the processor for
a bomb.
"""

from __future__ import annotations

import argparse
import gzip
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROWS, HUGE = 2_000_000, 36_000_000
DT = 0.02
MAX_MB, MAX_S = 600.0, 120.0
BOMB_MB, BOMB_S = 300.0, 5.0
BLOCK = 100_000


class Run(NamedTuple):
    """Exit code, seconds by the clock, seconds of the processor, peak memory in MB, last line."""

    code: int
    seconds: float
    cpu_s: float
    mb: float
    line: str


def write(path: Path, rows: int) -> None:
    """A unicycle that turns at 70 % of what it is told, with measurement noise, as CSV or CSV.gz."""
    rng = np.random.default_rng(3)
    x = y = theta = 0.0
    with gzip.open(path, "wt", compresslevel=1) if path.suffix == ".gz" else path.open("w") as file:
        file.write("t,x,y,theta,v,w\n")
        for a in range(0, rows, BLOCK):
            n = min(BLOCK, rows - a)
            v, w = (np.repeat(rng.uniform(-size, size, n // 20 + 1), 20)[:n] for size in (0.2, 2.0))
            turned = theta + DT * 0.7 * np.cumsum(w)
            heading = np.concatenate([[theta], turned[:-1]])
            moved = x + DT * np.cumsum(v * np.cos(heading)), y + DT * np.cumsum(v * np.sin(heading))
            there = np.concatenate([[x], moved[0][:-1]]), np.concatenate([[y], moved[1][:-1]])
            x, y, theta = float(moved[0][-1]), float(moved[1][-1]), float(turned[-1])
            seen = [one + 3e-4 * rng.normal(size=n) for one in there] + [
                (heading + 1e-3 * rng.normal(size=n) + math.pi) % (2 * math.pi) - math.pi
            ]
            np.savetxt(file, np.column_stack([DT * (a + np.arange(n)), *seen, v, w]), delimiter=",", fmt=["%.3f"] + ["%.6f"] * 5)


def run(*words: str) -> Run:
    """A verb in a process of its own, measured by the system."""
    begin = time.monotonic()
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(
            [sys.executable, "-m", "s2r_runtime", *words, "--model", "unicycle", "--dt", str(DT)], stdout=told, stderr=told
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        told.seek(0)
        lines = told.read().decode().strip().splitlines()
    return Run(
        process.returncode, time.monotonic() - begin, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, lines[-1] if lines else ""
    )


def bombs(folder: Path) -> dict[str, Path]:
    """Files that must be refused at once."""
    made = {"zip bomb of rows": folder / "rows.csv.gz", "zip bomb of zeros": folder / "zeros.csv.gz", "20 GB": folder / "large.csv"}
    with gzip.open(made["zip bomb of rows"], "wb") as file:
        file.write(b"t,x,y,theta,v,w\n")
        for _ in range(2000):
            file.write(b"0,0,0,0,0,0\n" * 80_000)
    with gzip.open(made["zip bomb of zeros"], "wb") as file:
        for _ in range(1000):
            file.write(bytes(1 << 20))
    with made["20 GB"].open("wb") as file:
        file.truncate(20_000_000_000)
    made["a pipe"] = folder / "pipe.csv"
    os.mkfifo(made["a pipe"])
    made["/dev/zero"] = Path("/dev/zero")
    return made


def main() -> int:
    """Prints a line a file and verb."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--huge", action="store_true", help="also a packed recording of 2 GB of text")
    huge = parser.parse_args().huge
    good = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tables = {"plain": (folder / "run.csv", ROWS), "packed": (folder / "run.csv.gz", ROWS)}
        if huge:
            tables["packed, huge"] = (folder / "huge.csv.gz", HUGE)
        for what, (path, rows) in tables.items():
            write(path, rows)
            for verb, right in (("gap", 3), ("trace", 0)):
                done = run(verb, str(path))
                within = done.code == right and done.mb <= MAX_MB and (rows > ROWS or done.cpu_s <= MAX_S)
                good &= within
                shares = f"{done.mb / MAX_MB:.2f} of the memory, {done.cpu_s / MAX_S:.2f} of the time"
                took = f"{done.cpu_s:6.1f} s of the processor, {done.seconds:6.1f} s  {done.mb:5.0f} MB"
                print(f"{what:18s} {verb:6s} {rows} rows  {took}  ({shares}){'' if within else '  MISSED'}")
            path.unlink()
        for what, path in bombs(folder).items():
            done = run("gap", str(path))
            within = done.code == 2 and done.mb <= BOMB_MB and done.cpu_s <= BOMB_S
            good &= within
            print(f"{what:18s} refused in {done.cpu_s:.1f} s of the processor, {done.mb:.0f} MB{'' if within else '  MISSED'}: {done.line}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
