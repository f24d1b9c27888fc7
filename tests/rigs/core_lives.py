"""Recorded lives of the core: every event of them, and what the core made of it when they were recorded.

An audit replays a log through the core and compares. So a core that answers an event otherwise than it did is one that finds yesterday's
logs wrong, and whoever changes it on purpose records the lives anew (`python tests/core_lives.py`) and says so in the changelog.

The file holds, gzipped MessagePack (JSON has no NaN, and some of these events do): lives, each a name, its events, a digest of the
outputs and of the status after each event.
"""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path

import msgspec

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import Event, Output, Started

FILE = Path(__file__).parent.parent / "replay" / "core_lives.msgpack.gz"
WALKS, STEPS = 12, 420
CASES = 260
"""Random walks and their steps, and seeded cases of faults: enough that every line of the core is run many times over."""
LATER: dict[str, object] = {
    "refused_campaign": None,
    "driven": (),
    "gap_attempts": 0,
    "behaviours": (),
    "tries": None,
    "latest_unix_s": 0,
    "clock_cleared": 0,
    "fixed_seed": False,
    "runs": (),
    "run_sequences": 0,
    "open_run": None,
    "runs_cleared": 0,
    "drives": 0,
    "run_limits": None,
    "later": False,
    "scenarios": None,
}
"""Fields of memory and outputs that came after the lives were recorded: at their defaults they say nothing else than before."""
LATER_STATUS = ("refused_campaign", "next_campaign", "next_attempt", "driven", "clock_behind_s", "runs")


class Life(msgspec.Struct, frozen=True):
    """`made`: a digest for each event."""

    name: str
    events: list[Event]
    made: list[bytes]


def replayed(events: list[Event]) -> list[bytes]:
    """What the core makes of these, event by event."""
    state, made = core.initial(), []
    for event in events:
        if isinstance(event, Started):  # a daemon that comes up, with what the one before it saved
            state = core.initial()
        state, outputs = core.handle(state, event)
        made.append(_digest(outputs, core.status(state)))
    return made


def _digest(outputs: tuple[Output, ...], status: dict[str, object]) -> bytes:
    plain = [msgspec.to_builtins(output) for output in outputs]
    for output in plain:
        memory = output.get("memory", {})
        certificates = [one for one in (output.get("facts"), *memory.get("certificates", ())) if one]
        for table in (output, memory, *certificates):
            for name, before in LATER.items():
                if name in table and table[name] == before:
                    del table[name]
    told = {name: value for name, value in status.items() if name not in LATER_STATUS}
    return hashlib.sha256(msgspec.msgpack.encode((plain, told))).digest()[:6]


def recorded() -> list[Life]:
    """The lives in the file."""
    return msgspec.msgpack.decode(gzip.decompress(FILE.read_bytes()), type=list[Life])


def _lives() -> list[tuple[str, list[Event]]]:
    import random

    import core_faults
    from core_world import World

    from s2r_runtime.messages import Stopping

    found = []
    for seed in range(WALKS):
        world = World(1000 + seed, lockstep=seed % 2 == 1)
        events: list[Event] = []
        feed = world.feed

        def keep(event: Event, events: list[Event] = events, feed: object = feed) -> None:
            events.append(event)
            feed(event)  # type: ignore[operator]

        world.feed = keep  # type: ignore[method-assign]
        world.begin()
        for _ in range(STEPS):
            world.step()
        world.feed(Stopping(world.t))
        found.append((f"walk {seed}", events))
    for number in range(CASES):
        world = core_faults.beginnings()[number % len(core_faults.beginnings())].fork()
        rng = random.Random(f"life/{number}")
        world.rng.seed(number)
        for _ in range(3):
            core_faults.FAULTS[rng.choice(core_faults.NAMES)](world, rng)
        core_faults.mend(world)
        found.append((f"faults {number}", [event for event, _ in world.events]))
    return found


def main() -> None:
    """Records them anew."""
    lives = []
    for name, events in _lives():
        try:
            again = msgspec.msgpack.decode(msgspec.msgpack.encode(events), type=list[Event])
        except (msgspec.DecodeError, OverflowError):  # a number or a word that no log could hold
            continue
        lives.append(Life(name, again, replayed(again)))
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_bytes(gzip.compress(msgspec.msgpack.encode(lives), mtime=0))
    print(f"{len(lives)} lives, {sum(len(life.events) for life in lives)} events, {FILE.stat().st_size} bytes")


if __name__ == "__main__":
    main()
