"""Walks through the core, random and exhaustive, judged after every event by a law of its own (core_law)."""

from __future__ import annotations

from collections import Counter

import msgspec
import pytest
from core_chapters import ALPHABET, CHAPTERS, chapter
from core_world import World

from s2r_runtime.core import reducer as core
from s2r_runtime.core.state import State
from s2r_runtime.messages import Started, Stopping

RUNS, STEPS = 15, 3200
"""Together 96 000 random events."""


def walk(seed: int, *, lockstep: bool) -> World:
    world = World(seed, lockstep=lockstep)
    world.begin()
    for _ in range(STEPS):
        world.step()
    world.feed(Stopping(world.t))
    assert world.law.requests - world.law.final <= world.lost, "a request without its answer"
    return world


@pytest.mark.parametrize("lockstep", [False, True], ids=["realtime", "lockstep"])
def test_no_random_walk_moves_the_robot_against_the_law(lockstep: bool) -> None:
    seen: Counter[str] = Counter()
    for seed in range(RUNS):
        seen += walk(seed, lockstep=lockstep).seen
    # the walks must have been where it matters, or they have shown nothing
    least = {"Send/controller": 800, "Send/sampler": 100, "opened": 200, "AlarmRaised": 5, "RadiusGrew": 100, "Revoked": 50}
    least |= {"TraceEnded": 50, "ModelAdopted": 5, "StartInputs": 20}
    assert {name: seen[name] for name, count in least.items() if seen[name] < count} == {}


@pytest.mark.parametrize("lockstep", [False, True], ids=["realtime", "lockstep"])
def test_a_logged_walk_replays_to_the_same_bytes(lockstep: bool) -> None:
    """What an audit does. Every state on the way can be written down and read back."""
    world = walk(98, lockstep=lockstep)
    assert isinstance(world.events[0][0], Started)
    state, decoder, number = core.initial(), msgspec.json.Decoder(State), 0
    for event, outputs in world.events:
        state, again = core.handle(state, event)
        assert msgspec.json.encode(again) == msgspec.json.encode(outputs)
        number += 1
        if number % 50 == 0:
            assert decoder.decode(msgspec.json.encode(state)) == state
    assert state == world.state
    assert number > 100


# ---------------------------------------------------------------- exhaustive


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lockstep"), CHAPTERS, ids=[f"{name}-{'lockstep' if lock else 'realtime'}" for name, lock in CHAPTERS])
def test_no_three_events_in_any_order_break_the_law(name: str, lockstep: bool) -> None:
    """From each chapter, every sequence of three letters (33 000 of them), and then a peaceful end in which much may come to light."""
    frontier = [chapter(name, lockstep=lockstep)]
    for _ in range(3):
        following = []
        for world in frontier:
            for letter in ALPHABET.values():
                other = world.fork()
                letter(other)
                following.append(other)
        frontier = following
    for world in frontier[::37]:  # a prime to the alphabet's length: every letter is last as often
        for letter in ["see", "answer"] * 5:
            ALPHABET[letter](world)
        world.feed(Stopping(world.t))
        assert world.law.requests - world.law.final <= world.lost
