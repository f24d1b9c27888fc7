"""How many faults of observations are too many: a fault in more than a few observations is a closed gate, not a flap (docs/gate.md).

A faulty observation, or a refused one (`ObservationRefused`), counts once, however many follow it before the next good one: what is bad all
the time keeps the gate closed by itself. With s = `Settings.fault_share`, b = `Settings.fault_burst` and the level L, at first 0:

    L := L + 1 - s           a fault, and the one before it was good
    L := max(0, L - s)       a good observation
    L > b                    the gate is closed and latched with `observation_faults`

This is a leaky bucket: in no stretch of n observations are more than s n + b such faults let pass (up to the rounding of floats).
"""

from __future__ import annotations

from s2r_runtime.core.sources import stop
from s2r_runtime.core.state import Turn
from s2r_runtime.messages import Observation

REASON = "observation_faults"


def note(turn: Turn, observation: Observation) -> None:
    """Keeps what is wrong with an observation, before the gate looks at it."""
    if observation.fault and not _latched(turn):
        turn.set(fault=observation.fault)


def judge(turn: Turn, observation: Observation, before: Observation | None) -> None:
    """Counts an observation that the core has taken in. before: the newest good one until then."""
    state = turn.state
    if state.observation is observation and before is not observation:
        turn.set(faulty=False, fault_level=max(0.0, state.fault_level - turn.settings.fault_share))
    elif observation.fault:
        _count(turn, observation.fault)
    elif state.trouble == "observation_invalid":
        _count(turn, "it is not finite, or not of the model's states")
    elif state.trouble and observation.seq == state.odd_seq:
        _count(turn, f"number {observation.seq} came after a newer one")


def refused(turn: Turn, detail: str) -> None:
    """Counts what the transport dropped."""
    _count(turn, detail)


def _count(turn: Turn, what: str) -> None:
    settings, state = turn.settings, turn.state
    if _latched(turn):  # what latched is not forgotten for what follows; what a second robot sends needs no second clearing
        return
    turn.set(fault=what)
    if not settings.fault_share or state.faulty:
        return
    turn.set(faulty=True, fault_level=state.fault_level + 1.0 - settings.fault_share)
    if turn.state.fault_level > settings.fault_burst:
        stop(turn, REASON, f"more than {settings.fault_share:.0%} of the observations are faulty, the last: {what}")


def _latched(turn: Turn) -> bool:
    return not {REASON, "robot_twin"}.isdisjoint(turn.memory.latched)


def forgive(turn: Turn) -> None:
    """A person looked after it."""
    turn.set(faulty=False, fault_level=0.0)
