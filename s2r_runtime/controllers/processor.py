"""What a process had of the processor, as Linux counts it: did it compute, or did it wait for its turn?"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class Used(NamedTuple):
    """Of a process's first thread, since it began. ran_ns: on a processor. waited_ns: ready to run, for its turn; a wait counts when it is
    over. ready: at this moment it runs, or waits for its turn or for the disk (swapped out).
    """

    ran_ns: int
    waited_ns: int
    ready: bool


def family(pid: int) -> list[int]:
    """The process and its descendants, as far as the kernel names them."""
    found = [pid]
    for parent in found:
        try:
            found += map(int, Path(f"/proc/{parent}/task/{parent}/children").read_text(encoding="ascii").split())
        except (OSError, ValueError):
            continue
    return found


def used(pid: int) -> Used | None:
    """None where the kernel does not say (no /proc, no schedstat), or the process is gone."""
    folder = Path(f"/proc/{pid}")
    try:
        ran, waited, _ = folder.joinpath("schedstat").read_text(encoding="ascii").split()
        state = folder.joinpath("stat").read_bytes().rpartition(b")")[2].split()[0]
        return Used(int(ran), int(waited), state in (b"R", b"D"))
    except (OSError, ValueError, IndexError):
        return None
