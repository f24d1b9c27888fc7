"""What this computer can hold, measured: how late it wakes a process up, how long its disk takes, and how much of a processor is to be had.

A profile has bounds on the robot's data and commands, and on how long disk and processes are waited for. Some computers cannot hold them, a
busy one for one. The gate then closes, as it must. The daemon says so when it starts, and `s2r doctor` before that.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from s2r_runtime.profile import Gate, Machine, Recording

NAP_S = 0.005
NAPS = 20
WRITTEN = bytes(16 << 10)
"""Some two chunks of a log at 100 Hz."""
HASHED = bytes(4 << 20)
"""Some milliseconds of computing that hold no lock of the interpreter's."""
FAIR_SHARE = 0.5
"""Less of a processor than this, and what computes takes more than twice as long."""


class Ability(NamedTuple):
    """wake_s: the latest of `wakes` wake-ups. sync_s: the slowest of `syncs`; 0 where none could be tried (`trouble`). share: of a
    processor that a computing process gets, 0 to 1.
    """

    wake_s: float
    wakes: int
    sync_s: float
    syncs: int
    share: float
    trouble: str = ""

    def __str__(self) -> str:
        disk = f"the disk cannot be tried: {self.trouble}" if self.trouble else f"a sync of the disk takes up to {_ms(self.sync_s)}"
        return f"wakes a process up to {_ms(self.wake_s)} late, {disk}, a computing process gets {100 * self.share:.0f} % of a processor"


def measure(folder: Path, seconds: float) -> Ability:
    """Tries it for so long. folder: on the disk where the logs are; it is left as it was."""
    wakes: list[float] = []
    syncs: list[float] = []
    ran_s = passed_s = 0.0
    trouble = ""
    until = time.monotonic() + seconds
    while not wakes or time.monotonic() < until:
        for _ in range(NAPS):
            begun = time.monotonic()
            time.sleep(NAP_S)
            wakes.append(max(0.0, time.monotonic() - begun - NAP_S))
        begun, used = time.monotonic(), time.thread_time()
        hashlib.sha256(HASHED)
        ran_s, passed_s = ran_s + time.thread_time() - used, passed_s + time.monotonic() - begun
        if not trouble:
            try:
                syncs.append(_sync(folder))
            except OSError as error:
                trouble = error.strerror or str(error)
    return Ability(max(wakes), len(wakes), max(syncs, default=0.0), len(syncs), min(1.0, ran_s / max(passed_s, 1e-9)), trouble)


def _sync(folder: Path) -> float:
    """Writes what a log writes, and has it on the disk; s."""
    with tempfile.TemporaryFile(dir=folder) as file:
        begun = time.monotonic()
        os.write(file.fileno(), WRITTEN)
        os.fdatasync(file.fileno())
        return time.monotonic() - begun


def not_held(ability: Ability, gate: Gate, recording: Recording, machine: Machine, *, realtime: bool) -> list[str]:
    """What of a profile's times this computer does not hold, a sentence for each; nothing where it holds all. In lockstep, where the robot
    waits, no delay closes the gate.
    """
    said = []
    waits = {
        "gate.controller_deadline": gate.controller_deadline,
        "gate.command_ttl": gate.command_ttl,
        "gate.observation_timeout": gate.observation_timeout,
        "machine.watch_delay": machine.watch_delay,
    }
    late = [f"{name} ({value:g} s)" for name, value in waits.items() if realtime and ability.wake_s > value]
    if late:
        said.append(
            f"it wakes a process up to {_ms(ability.wake_s)} late, more than {', '.join(late)}: the gate will close and open again; "
            "real-time priority helps (docs/install.md), and fewer programs beside"
        )
    if realtime and ability.sync_s > recording.max_delay:
        said.append(
            f"a sync of its disk takes up to {_ms(ability.sync_s)}, and a write may wait for it longer than recording.max_delay "
            f"({recording.max_delay:g} s): the gate will close until the log is written; put logs and state on another disk"
        )
    if realtime and 2.0 * ability.sync_s > machine.disk_timeout:
        said.append(
            f"a sync of its disk takes up to {_ms(ability.sync_s)}: openings of the gate and certificates may not be on it within "
            f"machine.disk_timeout ({machine.disk_timeout:g} s), and do not take effect then"
        )
    if ability.share < FAIR_SHARE:
        said.append(
            f"a computing process gets {100 * ability.share:.0f} % of a processor: a verification or a trace takes "
            f"{1.0 / max(ability.share, 0.01):.1f} times as long"
        )
    if ability.trouble:
        said.append(f"nothing can be written to its disk: {ability.trouble}")
    return said


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.1f} ms" if seconds < 0.1 else f"{seconds:.2f} s"
