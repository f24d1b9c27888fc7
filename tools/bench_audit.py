"""How long an audit takes, and how much memory: of a log as long as an hour at 100 Hz, and of one of a tenth of that (docs/auditor.md).

    tools/bench_audit.py [--minutes 60] [--logs FOLDER] [--quick] [--json]

The logs are those of whole runs (campaign, gap, certificate, then driving), made by the core itself as fast as it computes: for each
second 100 observations, 50 ticks, and what follows from them. Each is audited by a process of its own: time by the clock and of the
processor, and the largest memory of an audit's three processes (the two beside the first count as twice the larger of them).
Exit 0: an hour takes at most a minute (on a machine that does nothing else), and ten times the log at most 1.3 times the memory.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "rigs"))

import audit_bench

from s2r_runtime import messages as m
from s2r_runtime.recording.writer import Writer

PER_SECOND = 100
LIMIT_S = 60.0
GROWTH = 1.3
AUDIT = """
import json, resource, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import audit_bench
from s2r_runtime.audit.log import audit
begun, cpu = time.monotonic(), time.process_time()
result = audit([Path(one) for one in sys.argv[2:]])
took, cpu = time.monotonic() - begun, time.process_time() - cpu
own, child = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
print(json.dumps({
    "ok": result.ok and not result.missing, "records": result.records, "seconds": took, "cpu_s": cpu,
    "beside_cpu_s": child.ru_utime + child.ru_stime,
    "megabytes": own.ru_maxrss / 1024, "beside_megabytes": 2 * child.ru_maxrss / 1024,
}))
"""


class Sink(list[Any]):
    """Writes what is put in, and keeps nothing."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.writer = Writer(path, run="bench", signer=audit_bench.KEY, metadata={"robot": "bench"}, timed=False)
        self._count = 0

    def append(self, item: Any) -> None:
        """One message, or (name, media type, bytes) to attach. A chunk for every 5 observations, as many as a daemon makes."""
        if isinstance(item, tuple):
            self.writer.attach(*item)
        else:
            self.writer.write(item, getattr(item, "t_ns", 0))
        self._count += 1
        if self._count % 43 == 0:
            self.writer.flush()

    def __iadd__(self, items: Iterable[Any]) -> Sink:  # type: ignore[misc,override]
        for item in items:
            self.append(item)
        return self

    def __iter__(self) -> Iterator[Any]:
        return iter(())


class Streamed(audit_bench.Bench):  # type: ignore[misc,name-defined]
    """A bench whose log is written while it runs."""

    sink: Sink

    @property
    def items(self) -> Sink:
        """Where the run puts its messages: not a list of them, but the file."""
        return self.sink

    @items.setter
    def items(self, given: Iterable[Any]) -> None:
        if given is not self.sink:
            self.sink += given


def make(path: Path, observations: int) -> None:
    """A log of so many observations."""
    Streamed.sink = Sink(path)
    with tempfile.TemporaryDirectory() as folder:
        bench = Streamed(Path(folder)).sample()
        bench.drive(0)
        while bench.seq < observations:
            bench.step()
            if bench.seq % 2:
                bench.feed(m.Ticked(0))
        bench.stop()
    Streamed.sink.writer.close()


def audited(path: Path) -> dict[str, Any]:
    """The log, all parts of it, by a process of its own."""
    parts = [path, *sorted(path.parent.glob(f"{path.stem}.*.mcap"))]
    tests = str(Path(__file__).resolve().parent.parent / "tests" / "rigs")
    done = subprocess.run([sys.executable, "-c", AUDIT, tests, *map(str, parts)], capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return {**found, "file_megabytes": sum(one.stat().st_size for one in parts) / 1e6}


def main() -> int:
    """Exit 0 if it is fast enough, and its memory does not grow with the log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--logs", type=Path, help="where the logs are made, and stay; those that are there are audited as they are")
    parser.add_argument("--quick", action="store_true", help="six minutes")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    minutes = 6.0 if args.quick else args.minutes
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for share in (0.1, 1.0):
            path = (args.logs or Path(folder)) / f"{share * minutes:g}-minutes.mcap"
            if not path.exists():
                make(path, round(share * minutes * 60 * PER_SECOND))
            found.append({"minutes": share * minutes, **audited(path)})
    short, long = found
    growth = (long["megabytes"] + long["beside_megabytes"]) / (short["megabytes"] + short["beside_megabytes"])
    an_hour_s = long["seconds"] * 60.0 / minutes
    ok = short["ok"] and long["ok"] and growth <= GROWTH and an_hour_s <= LIMIT_S
    if args.json:
        print(json.dumps({"logs": found, "memory_ratio": growth, "an_hour_s": an_hour_s, "ok": ok}))
    else:
        for one in found:
            print(
                f"{one['minutes']:g} min at 100 Hz: {one['records']} records, {one['file_megabytes']:.0f} MB: "
                f"{one['seconds']:.1f} s ({one['cpu_s']:.1f} s and beside that {one['beside_cpu_s']:.1f} s of the processor), "
                f"{one['megabytes']:.0f} and {one['beside_megabytes']:.0f} MB of memory"
            )
        print(f"an hour: {an_hour_s:.0f} s; ten times the log: {growth:.2f} times the memory")
    return 0 if ok else 1


if __name__ == "__main__":
    raise SystemExit(main())
