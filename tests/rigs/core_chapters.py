"""What can happen to the core as letters, and the places in its life where much can go wrong as chapters: for walks and faults."""

from __future__ import annotations

import math
from collections.abc import Callable

from core_law import DT
from core_world import World

from s2r_runtime.messages import (
    AnalyticsChanged,
    Command,
    LinkChanged,
    Measured,
    Observation,
    Observed,
    OverrideChanged,
    Proposed,
    RecorderChanged,
    SourceStopped,
    Ticked,
    WallClockRead,
)

Letter = Callable[[World], None]


def _answer(u: tuple[float, float], source: str = "controller") -> Letter:
    def letter(world: World) -> None:
        obs_seq = world.ask.obs_seq if world.ask is not None else world.seq
        world.numbers += 1
        world.feed(Proposed(world.t, Command(world.numbers, world.t, source, u, obs_seq, 2 * DT)))  # type: ignore[arg-type]

    return letter


def _see(x: tuple[float, ...], step: int = DT) -> Letter:
    def letter(world: World) -> None:
        world.t += step
        world.seq += 1
        world.recent = Observation(world.seq, world.t, x)
        world.feed(Observed(world.t, world.recent))

    return letter


def _repeat(world: World) -> None:
    if world.recent is not None:
        world.feed(Observed(world.t, world.recent))


def _measure(factor: float, e_value: float = 1.0, fault: str = "") -> Letter:
    return lambda world: world.feed(Measured(world.t, world.seq, factor * 0.01, fault, e_value, 1, 0))


def _duty(world: World) -> None:
    if world.duties:
        world.rng.seed(1)  # 0.13, 0.85: the duty that is first, done well
        world.duty()


ALPHABET: dict[str, Letter] = {
    "see": _see((0.5, 0.2, 0.0)),
    "see late": _see((0.5, 0.2, 0.0), 6 * DT),
    "see outside": _see((1.7, 0.0, 0.0)),
    "see nothing": _see((math.nan, 0.0, 0.0)),
    "see the past": lambda world: world.feed(Observed(world.t, Observation(1, 1, (0.0, 0.0, 0.0)))),
    "repeat": _repeat,
    "answer": _answer((0.1, 1.0)),
    "answer nan": _answer((math.nan, 1.0)),
    "answer too much": _answer((0.3, 1.0)),
    "sampler answers": _answer((0.1, 1.0), "sampler"),
    "outsider": _answer((0.1, 1.0), "external"),
    "grow": _measure(1.3),
    "outgrow": _measure(7.0),
    "alarm": _measure(0.1, e_value=1e3),
    "duty": _duty,
    "tick": lambda world: world.feed(Ticked(world.later(3 * DT))),
    "clock back": lambda world: (setattr(world, "t", world.t - 1), world.feed(Ticked(world.t)))[1],  # type: ignore[func-returns-value]
    "died": lambda world: world.feed(SourceStopped(world.t, "controller", "died")),
    "link down": lambda world: world.feed(LinkChanged(world.t, up=False)),
    "link up": lambda world: world.feed(LinkChanged(world.t, up=True)),
    "recorder down": lambda world: world.feed(RecorderChanged(world.t, ok=False)),
    "analytics down": lambda world: world.feed(AnalyticsChanged(world.t, up=False)),
    "expire": lambda world: world.feed(WallClockRead(world.t, 9000)),
    "override": lambda world: world.feed(OverrideChanged(world.t, "manual_override")),
    "stop": lambda world: world.request("stop"),
    "clear": lambda world: world.request("clear", text="emergency_stop"),
    "permit": lambda world: world.request("permit", duration_s=1.0),
    "sample": lambda world: world.request("sample"),
    "deploy": lambda world: world.request("deploy", digest="c1"),
    "undeploy": lambda world: world.request("undeploy"),
    "revoke": lambda world: world.request("revoke"),
    "restart": lambda world: world.restart(orderly=False),
}


def chapter(name: str, *, lockstep: bool) -> World:
    """A world at a place where much can go wrong."""
    world = World(3, lockstep=lockstep, tracing=False)
    world.rng.seed(3)

    def spell(*letters: str) -> None:
        for letter in letters:
            ALPHABET[letter](world)

    world.begin()
    spell("see", "permit", "sample", "duty", "see", "sampler answers")
    assert world.law.sampling
    if name == "sampling":
        spell("see")
        return world
    world.finish_campaign()
    spell("duty", "deploy")
    if name == "verifying":
        return world
    spell("duty", "duty", "duty", "duty", *(["see", "answer"] * 5))
    assert world.law.gate
    if name == "asked":
        spell("see")
    elif name == "outgrown":
        spell("outgrow")
    return world


CHAPTERS = [("sampling", False), ("verifying", False), ("driving", False), ("asked", False), ("outgrown", False)]
CHAPTERS += [("sampling", True), ("asked", True)]
