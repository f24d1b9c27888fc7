"""What the daemon loads for this transport is small: no dialect of pymavlink, and never its `mavutil`."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
from s2r_mavlink.transport import MavlinkTransport
import s2r_mavlink.tlog
t = MavlinkTransport({"robot": "udp:127.0.0.1:1"}, ("x", "y", "theta"), ("v", "w"))
loaded = [name for name in sys.modules if name.startswith("pymavlink")]
assert not loaded, loaded
"""


def test_transport_and_reader_need_nothing_of_pymavlink() -> None:
    assert subprocess.run([sys.executable, "-c", PROGRAM], timeout=60, check=False).returncode == 0


STAND_IN = """
import sys
import s2r_mavlink.rover
print([name for name in sys.modules if name.startswith("pymavlink.")])
"""


def test_stand_in_needs_one_dialect_only() -> None:
    done = subprocess.run([sys.executable, "-c", STAND_IN], timeout=60, check=True, capture_output=True, text=True)
    assert "v20.common" in done.stdout
    assert "mavutil" not in done.stdout
    assert "ardupilotmega" not in done.stdout
