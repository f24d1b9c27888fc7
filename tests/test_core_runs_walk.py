"""Random walks through the core: whatever happens, each run in which a controller commanded the robot is counted once (G10)."""

from __future__ import annotations

import random

import msgspec
import pytest
from core_law import Law
from core_world import World

from s2r_runtime.core import runs
from s2r_runtime.messages import (
    EpisodeCounted,
    EpisodeEnded,
    EpisodeScored,
    Event,
    Output,
    Requested,
    RunCounts,
    Send,
    StartController,
    Started,
)

STEPS = 2500


class Counting(World):
    """A world whose controllers drive scenarios, with an accountant of its own."""

    def __init__(self, seed: int, *, lockstep: bool) -> None:
        super().__init__(seed, lockstep=lockstep)
        self.settings = msgspec.structs.replace(self.settings, beta_episodes=0.3, max_unsafe=0.02, gate_closing="censored")
        self.law = Law(self.settings)
        self.dice = random.Random(seed)
        self.driving = self.commanded = False
        self.outcomes: list[str] = []
        self.refusals = 0

    def answer(self) -> Event:
        if self.ask is not None and self.ask.source == "controller" and self.dice.random() < 0.08:
            self.scenario_over()
        return super().answer() if self.ask is not None else self.observed_instead()

    def observed_instead(self) -> Event:
        """What the report of the scenario led to has ended the deployment: there is nothing to answer."""
        return EpisodeScored(self.t, 0, 1, 0.0, below=False)

    def scenario_over(self) -> None:
        safety = self.dice.choices([0.5, -0.5], [85, 15])[0]
        if self.dice.random() < 0.2:
            self.feed(EpisodeScored(self.t, 0, 5, safety, below=safety < 0.0))
        self.feed(EpisodeEnded(self.t, 0, 20, safety, 1.0))

    def operate(self) -> None:
        if self.dice.random() < 0.05:
            self.request("clear", text=runs.REASON)
        else:
            super().operate()

    def feed(self, event: Event) -> None:
        before = self.state
        crashed = isinstance(event, Started) and self.memory.open_run is not None
        super().feed(event)
        outputs = self.events[-1][1]
        self.account(event, outputs, crashed=crashed)
        self.hold_counts(event, before.memory.runs, outputs)

    def account(self, event: Event, outputs: tuple[Output, ...], *, crashed: bool) -> None:
        """Exactly one outcome for a run in which the controller commanded, at most one for another."""
        counted = [output for output in outputs if isinstance(output, EpisodeCounted)]
        self.outcomes += [one.outcome for one in counted]
        if crashed:
            assert [one.outcome for one in counted] == ["censored"]
            self.driving = self.commanded = False
            return
        expected = 0
        if isinstance(event, EpisodeEnded) and self.driving:
            expected, self.commanded = expected + self.commanded, False
        for output in outputs:
            self.driving |= isinstance(output, StartController)
            self.commanded |= isinstance(output, Send) and output.source == "controller"
        if self.driving and self.state.deployment is None:
            expected, self.driving, self.commanded = expected + self.commanded, False, False
        assert expected <= len(counted) <= 1, (event, outputs)

    def hold_counts(self, event: Event, before: tuple[RunCounts, ...], outputs: tuple[Output, ...]) -> None:
        """The counts grow by the outcomes, and by nothing else; a refused controller does not start."""
        memory = self.state.memory
        cleared = isinstance(event, Requested) and event.text == runs.REASON
        old = {one.controller: one for one in before if not one.certificate}
        if isinstance(event, Started):
            old = {one.controller: one for one in event.memory.runs if not one.certificate}
        grown = {output.controller: output.outcome for output in outputs if isinstance(output, EpisodeCounted)}
        for now in (one for one in memory.runs if not one.certificate):
            was = old.get(now.controller, RunCounts(now.controller, "", now.number, now.beta))
            outcome = grown.get(now.controller, "left_out")
            assert now.n == was.n + (outcome != "left_out")
            assert (now.unsafe, now.censored) == (was.unsafe + (outcome == "unsafe"), was.censored + (outcome == "censored"))
            assert now.number == was.number
            assert now.exceeded >= was.exceeded
            self.refusals += now.exceeded > was.exceeded
        if not cleared:
            assert old.keys() <= {one.controller for one in memory.runs}
        for output in outputs:
            if isinstance(output, StartController):
                assert not runs.refusal(memory, self.settings, output.digest)
        if not isinstance(event, Started):
            assert (memory.open_run is not None) == (self.state.run is not None or self._starts()), event

    def _starts(self) -> bool:
        deployment = self.state.deployment
        return deployment is not None and deployment.stage != "verifying"


def walked(seed: int, *, lockstep: bool, steps: int = STEPS) -> Counting:
    world = Counting(seed, lockstep=lockstep)
    world.begin()
    for _ in range(steps):
        world.step()
        if world.dice.random() < 0.002:
            world.restart(orderly=world.dice.random() < 0.3)
    return world


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_each_run_is_counted_once_whatever_happens(seed: int, lockstep: bool) -> None:
    assert walked(seed, lockstep=lockstep).seen["Send/controller"] > 0


@pytest.mark.slow
def test_long_walks_meet_every_outcome_and_refusals() -> None:
    seen: dict[str, int] = {}
    refusals = 0
    for seed in range(30, 40):
        world = walked(seed, lockstep=bool(seed % 2), steps=2 * STEPS)
        refusals += world.refusals
        for outcome in world.outcomes:
            seen[outcome] = seen.get(outcome, 0) + 1
    assert refusals > 0
    assert min(seen.get(kind, 0) for kind in ("safe", "unsafe", "censored", "left_out")) > 5, seen
