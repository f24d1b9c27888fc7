"""A kill and a power cut cost nothing that took effect; what is left is read, and recovered. (10^4 of each: make bench.)"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

TOOL = Path(__file__).parent.parent / "tools" / "bench_crash.py"


def test_kills_and_power_cuts_cost_no_opening_and_no_certificate_and_leave_readable_logs() -> None:
    command = [sys.executable, str(TOOL), "--count", "60", "--seed", "7", "--jobs", "2", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    found = json.loads(done.stdout)
    for what in ("SIGKILL", "power cut"):
        one = found[what]
        assert (one["trials"], one["lost_critical"], one["lost_promised"], one["unreadable"], one["unopened"]) == (60, 0, 0, 0, 0), what
        assert [line for line in one["wrong"] if "ms are lost" not in line] == [], what
        assert one["in_effect"] > 20, f"{what}: nothing was at stake"
    assert found["SIGKILL"]["worst_s"] < 1.0, "how much it is on a machine that does nothing else: make bench"
