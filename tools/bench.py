"""make bench: every benchmark after the other, with the figures that the docs state. `--quick` for a smoke run.

Each is a program of its own (tools/bench_*.py) and can be run alone; this one runs them in order, so that no two disturb each other.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ORDER = (
    "bench_verify.py",
    "bench_stl.py",
    "bench_daemon.py",
    "bench_gate_faults.py",
    "bench_daemon_faults.py",
    "fuzz_door.py",
    "bench_crash.py",
    "bench_tamper.py",
    "bench_fields.py",
    "bench_audit.py",
    "bench_recordings.py",
    "bench_can.py",
    "fuzz_can.py",
    "bench_mavlink.py",
    "bench_ros2.py",
    "fuzz_ros2.py",
    "bench_coverage.py",
    "bench_compare.py",
    "bench_composition.py",
    "bench_duplicates.py",
    "bench_grinding.py",
    "bench_rates.py",
    "bench_missions.py",
    "bench_episodes.py",
)


def main() -> int:
    """Exit 0 if every benchmark ran and none found a fault."""
    failed = []
    for name in ORDER:
        print(f"\n== {name}", flush=True)
        if subprocess.call([sys.executable, str(HERE / name), *sys.argv[1:]]):
            failed.append(name)
    print(f"\n{len(ORDER) - len(failed)} passed, {len(failed)} failed" + (f": {', '.join(failed)}" if failed else ""))
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
