"""Kills processes that record, and cuts the power on recorded writes, at random points; counts what is lost (docs/log-format.md).

    tools/bench_crash.py [--count 10000] [--seed 1] [--jobs 4] [--quick] [--json]

Kill: a forked process records through the recorder as the daemon does, 1000 messages a second, in parts of 6 kB. Gate openings and
certificates it makes durable, and only then says (in shared memory) that they took effect. It gets SIGKILL at a random time, also while it
begins, rotates or closes. Power: every write and every fsync of such a recording is kept; at a random point, what was not synced is
dropped, cut off, or left in some of its pages (the others zeros).

Counted: openings and certificates that took effect and are not in what the log's reader vouches for; how much time everything else that is
lost spans, less by how much the process itself woke up late (kill); messages that were synced and are not there (power); logs
that cannot be read; recovered files that the indexed reader of the mcap package does not open. Exit 0: none of these, and no span
above 100 ms.
"""

from __future__ import annotations

import argparse
import io
import json
import mmap
import os
import random
import signal
import struct
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.reader import SeekingReader

from s2r_runtime.errors import S2RError
from s2r_runtime.messages import CertificateFacts, CertificateInstalled, Frame, GateChanged, Struct, Ticked
from s2r_runtime.recording import logfile, writer
from s2r_runtime.recording.logs import runs
from s2r_runtime.recording.recorder import Recorder
from s2r_runtime.recording.salvage import recover
from s2r_runtime.recording.writer import Writer

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
LOSS_S = 0.1
"""What a kill may cost of everything but openings and certificates."""
HZ = 1000
PART_BYTES = 6_000
LIFE_S = 0.25
"""A process gets its SIGKILL within that time of its first message."""
PATIENCE_S = 30.0
SLOTS = 4096
PAGE = 4096
HEAD = struct.Struct("<dQQ")
"""Shared with the parent: by how much it woke up late, messages put, messages that took effect since they are durable."""


def message(k: int, rng: random.Random) -> Struct:
    """The k-th; its number is its time."""
    if k % 25 == 20:
        return GateChanged(k, k % 50 == 20, "allowed")
    if k % 100 == 60:
        return CertificateInstalled(k, CertificateFacts("sha256:aa", *["sha256:bb"] * 4, 1, 0.1, 0.2, 0, 10**9, 1))
    return Frame(k, "robot/observation", rng.randbytes(30)) if k % 2 else Ticked(k)


def critical(one: Struct) -> bool:
    """Whether the daemon waits for the disk before this takes effect: losing one is a failure."""
    return isinstance(one, CertificateInstalled) or (isinstance(one, GateChanged) and one.open)


@dataclass
class Found:
    """What was counted."""

    trials: int = 0
    lost_critical: int = 0
    lost_promised: int = 0
    worst_s: float = 0.0
    unreadable: int = 0
    unopened: int = 0
    kept: int = 0
    in_effect: int = 0
    wrong: list[str] = field(default_factory=list)

    def add(self, what: str) -> None:
        """Notes what should not have been."""
        self.wrong.append(what)


# ---------------------------------------------------------------- SIGKILL


def record_until_killed(path: Path, shared: mmap.mmap, seed: int) -> None:
    """Runs in the child. Every put is stamped in shared memory after it returned."""
    rng = random.Random(seed)
    recorder = Recorder(Writer(path, run="crash", signer=KEY, rotate_bytes=PART_BYTES, timed=False))
    late = 0.0

    def lateness() -> None:
        """How late this machine lets a thread do what the recorder's does: wake up, and hand a few bytes to the file system."""
        nonlocal late
        fd = os.open(path.with_suffix(".probe"), os.O_WRONLY | os.O_CREAT)
        while True:
            begun = time.monotonic()
            time.sleep(0.01)
            os.pwrite(fd, b"x" * 500, 0)
            late = max(late, time.monotonic() - begun - 0.01)
            struct.pack_into("<d", shared, 0, late)

    threading.Thread(target=lateness, daemon=True).start()
    end = random.Random(-seed).choice((SLOTS, SLOTS, SLOTS, 30, 100, 200))
    due = time.monotonic()
    for k in range(SLOTS):
        one = message(k, rng)
        recorder.put(one, k)
        struct.pack_into("<d", shared, HEAD.size + 8 * k, time.monotonic())
        struct.pack_into("<Q", shared, 8, k + 1)
        if critical(one) and recorder.durable(60.0):
            struct.pack_into("<Q", shared, 16, k + 1)
        if k >= end:
            recorder.close()
            time.sleep(60.0)
        due += 1.0 / HZ
        time.sleep(max(0.0, due - time.monotonic()))
    time.sleep(60.0)


def killed(folder: Path, seed: int, found: Found) -> None:
    """One process, killed at a random time, and what is left of its log."""
    rng = random.Random(~seed)
    begun = rng.random() < 0.9  # else it is killed while it begins
    with mmap.mmap(-1, HEAD.size + 8 * SLOTS) as shared:
        pid = os.fork()
        if pid == 0:
            with suppress(BaseException):
                record_until_killed(folder / "a.mcap", shared, seed)
            os._exit(1)
        deadline = time.monotonic() + PATIENCE_S
        while begun and not HEAD.unpack_from(shared, 0)[1] and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, LIFE_S if begun else LIFE_S / 10))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        late, put, effective = HEAD.unpack_from(shared, 0)
        times = struct.unpack_from(f"<{put}d", shared, HEAD.size)
    found.trials += 1
    kept = left(folder, found, f"kill, seed {seed}")
    if kept is None:
        return
    made = random.Random(seed)
    wanted = [message(k, made) for k in range(max(put, len(kept)))]
    if kept != wanted[: len(kept)]:
        found.add(f"kill, seed {seed}: the log holds something else than was put")
    found.kept += len(kept)
    found.in_effect += sum(critical(one) for one in wanted[:effective])
    if len(kept) < effective:
        found.lost_critical += sum(critical(one) for one in wanted[len(kept) : effective])
        found.add(f"kill, seed {seed}: {effective} messages were durable, {len(kept)} are there")
    if len(kept) < put:
        span = times[-1] - times[len(kept)] - late
        found.worst_s = max(found.worst_s, span)
        if span > LOSS_S:
            found.add(f"kill, seed {seed}: {span * 1e3:.0f} ms are lost, beside {late * 1e3:.0f} ms of waking up late")


def left(folder: Path, found: Found, what: str) -> list[Struct] | None:
    """The messages that the reader vouches for, over all parts; None if there is no log yet. Every file is recovered, too."""
    paths = sorted(path for path in folder.iterdir() if path.suffix == ".mcap")
    if not paths:
        return []
    kept: list[Struct] = []
    try:
        (parts,) = runs(paths) if len(paths) == 1 else [[r for group in runs(paths) for r in group if r.run]]
        for reading in parts:
            kept += [entry.message for entry in reading]
            if reading.ending.kind != "rotated" and not (reading.ending.kind == "cut" and reading.sealed_for_good):
                break  # as an audit does: a part whose index was not written yet lacks no message
        if any(reading.over and reading.ending.kind == "broken" for reading in parts):
            what += f" ({next(r.ending.detail for r in parts if r.over and r.ending.kind == 'broken')})"
            found.unreadable += "power" not in what
            if "power" not in what:
                found.add(f"{what}: broken")
    except S2RError as error:
        found.unreadable += 1
        found.add(f"{what}: {error}")
        return None
    for path in paths:
        reopened(path, found, what)
    return kept


def reopened(path: Path, found: Found, what: str) -> None:
    """The recovered file must open by its index, and hold what the account says. A file that has no message yet has nothing to recover."""
    out = path.with_suffix(".recovered")
    try:
        account = recover(path, out)
    except S2RError:
        return
    try:
        with out.open("rb") as file:
            n = sum(1 for _ in SeekingReader(file, validate_crcs=True).iter_messages())
        if n != account["records"]:
            raise ValueError(f"{n} messages, recover says {account['records']}")
    except Exception as error:  # noqa: BLE001 - whatever a reader of others raises
        found.unopened += 1
        found.add(f"{what}: {path.name} was recovered, and does not open: {error}")
    out.unlink()


# ---------------------------------------------------------------- power


@dataclass
class Disk:
    """Every write, sync and promise of a recording, in order."""

    steps: list[tuple[str, str, int, bytes]] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)

    def layer(self) -> Any:
        """What stands for `os` in the module that writes."""
        real = os

        def opened(path: Any, flags: int, mode: int = 0o777) -> int:
            fd = real.open(path, flags, mode)
            if flags & real.O_CREAT:
                self.names[fd] = Path(path).name
                self.steps.append(("create", self.names[fd], 0, b""))
            else:
                self.names.pop(fd, None)
            return fd

        def pwrite(fd: int, data: Any, at: int) -> int:
            self.steps.append(("write", self.names[fd], at, bytes(data)))
            return real.pwrite(fd, data, at)

        def sync(fd: int) -> None:
            self.steps.append(("sync", self.names.get(fd, ""), 0, b""))

        def dup(fd: int) -> int:
            other = real.dup(fd)
            self.names[other] = self.names[fd]
            return other

        same = ("O_RDWR", "O_CREAT", "O_EXCL", "O_CLOEXEC", "O_RDONLY", "close", "pread", "ftruncate")
        names = {name: getattr(real, name) for name in same}
        return SimpleNamespace(**names, open=opened, pwrite=pwrite, fsync=sync, fdatasync=sync, dup=dup)


def recorded(folder: Path, seed: int) -> tuple[Disk, list[Struct], int]:
    """A recording's steps; `promise` among them says how many messages are durable. (steps, messages, ...)."""
    rng, disk, made = random.Random(seed), Disk(), list[Struct]()
    honest = logfile.os  # type: ignore[attr-defined]
    logfile.os = disk.layer()  # type: ignore[attr-defined]
    try:
        log = Writer(folder / "a.mcap", run="power", signer=KEY, rotate_bytes=rng.choice((0, PART_BYTES)), timed=False)
        for k in range(rng.randrange(20, 400)):
            one = message(k, rng)
            made.append(one)
            log.write(one, k)
            if critical(one):
                log.durable()
                disk.steps.append(("promise", "", k + 1, b""))
            elif rng.random() < 0.05:
                log.flush()
                if rng.random() < 0.3:
                    log.sync()
                    disk.steps.append(("promise", "", k + 1, b""))
        if rng.random() < 0.7:
            log.close()
        else:
            log.abandon()
    finally:
        logfile.os = honest  # type: ignore[attr-defined]
    return disk, made, seed


def cut_power(disk: Disk, made: list[Struct], folder: Path, rng: random.Random, found: Found) -> None:
    """What is on the disk after a power cut at a random step, and what is left of the log."""
    at = rng.randrange(1, len(disk.steps) + 1)
    promised = max((n for kind, _, n, _ in disk.steps[:at] if kind == "promise"), default=0)
    for name, data in surviving(disk.steps[:at], rng).items():
        (folder / name).write_bytes(data)
    found.trials += 1
    kept = left(folder, found, f"power cut at step {at}")
    for path in folder.iterdir():
        path.unlink()
    if kept is None:
        return
    if kept != made[: len(kept)]:
        found.add(f"power cut at step {at}: the log holds something else than was put")
    found.kept += len(kept)
    found.in_effect += sum(critical(one) for one in made[:promised])
    if len(kept) < promised:
        found.lost_critical += sum(critical(one) for one in made[len(kept) : promised])
        found.lost_promised += promised - len(kept)
        found.add(f"power cut at step {at}: {promised} messages were on the disk, {len(kept)} are there")


def surviving(steps: list[tuple[str, str, int, bytes]], rng: random.Random) -> dict[str, bytes]:
    """File -> bytes. What was synced is there. Of the rest: nothing, a beginning, some pages, or its length in zeros."""
    synced: dict[str, int] = {}
    files: dict[str, io.BytesIO] = {}
    for kind, name, at, data in steps:
        if kind == "create":
            files[name], synced[name] = io.BytesIO(), 0
        elif kind == "write":
            files[name].seek(at)
            files[name].write(data)
        elif kind == "sync" and name in files:
            synced[name] = len(files[name].getvalue())
    found = {}
    for name, file in files.items():
        whole, safe = file.getvalue(), synced[name]
        match rng.randrange(4):
            case 0:
                data = whole[:safe]
            case 1:
                data = whole[: rng.randint(safe, len(whole))]
            case 2:
                data = whole[:safe] + bytes(rng.randint(0, len(whole) - safe))
            case _:
                pages = bytearray(whole)
                for page in range(safe // PAGE, len(whole) // PAGE + 1):
                    if rng.random() < 0.5:
                        first = max(safe, page * PAGE)
                        pages[first : (page + 1) * PAGE] = bytes(max(0, min(len(whole), (page + 1) * PAGE) - first))
                data = bytes(pages)
        found[name] = data
    return found


# ---------------------------------------------------------------- all of it


def kills(count: int, seed: int) -> Found:
    """So many processes, one after the other."""
    found, about = Found(), writer.environment()
    writer.environment = lambda: about  # read once: 10 000 processes need not ask for the versions of the same packages
    for number in range(count):
        with tempfile.TemporaryDirectory() as folder:
            killed(Path(folder), seed * 1_000_003 + number, found)
    return found


def power_cuts(count: int, seed: int, each: int = 25) -> Found:
    """So many cuts, `each` on one recording."""
    found, rng = Found(), random.Random(seed)
    while found.trials < count:
        with tempfile.TemporaryDirectory() as source, tempfile.TemporaryDirectory() as folder:
            disk, made, _ = recorded(Path(source), rng.randrange(1 << 40))
            for _ in range(min(each, count - found.trials)):
                cut_power(disk, made, Path(folder), rng, found)
    return found


def beside(count: int, seed: int, jobs: int) -> Found:
    """`kills` in so many processes at once: most of the time they sleep."""
    total, children = Found(), []
    for job in range(jobs):
        r, w = os.pipe()
        share = count // jobs + (job < count % jobs)
        if (pid := os.fork()) == 0:
            os.close(r)
            part = kills(share, seed * 101 + job)
            with os.fdopen(w, "w") as out:
                json.dump(vars(part), out)
            os._exit(0)
        os.close(w)
        children.append((pid, r))
    for pid, r in children:
        with os.fdopen(r) as source:
            text = source.read()
        os.waitpid(pid, 0)
        part = Found(**json.loads(text))
        for name in ("trials", "lost_critical", "lost_promised", "unreadable", "unopened", "kept", "in_effect"):
            setattr(total, name, getattr(total, name) + getattr(part, name))
        total.worst_s = max(total.worst_s, part.worst_s)
        total.wrong += part.wrong
    return total


def main() -> int:
    """Exit 0 if nothing was lost that may not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="kills, and as many power cuts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=4)
    parser.add_argument("--quick", action="store_true", help="200 of each")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    count = 200 if args.quick else args.count
    results = {"SIGKILL": beside(count, args.seed, args.jobs), "power cut": power_cuts(count, args.seed)}
    if args.json:
        print(json.dumps({name: vars(one) for name, one in results.items()}))
    else:
        for name, one in results.items():
            print(f"{name}: {one.trials} trials, {one.kept} messages kept, {one.in_effect} openings and certificates in effect")
            print(f"    lost: {one.lost_critical} openings or certificates; unreadable: {one.unreadable}; not opened then: {one.unopened}")
            if name == "SIGKILL":
                print(f"    worst loss of everything else: {one.worst_s * 1e3:.0f} ms")
            for line in one.wrong[:10]:
                print(f"    {line}")
    return 1 if any(one.wrong for one in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
