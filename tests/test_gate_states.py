"""The state machine of docs/gate.md, drawn there and walked through here: every state that can be told apart, with every event in it.

Two states of the core are taken for one if nothing that the document speaks of tells them apart (`what_matters`). From one of each, every
event of the alphabet is tried, judged by the law (`core_law`), until nothing new appears: no reachable state forwards a command that
isn't allowed, and the arrows that were seen are the arrows that are drawn.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from functools import cache
from typing import Any

from core_chapters import ALPHABET, Letter, chapter
from core_law import DT
from core_rig import Rig
from core_world import World
from gate_law import DOCUMENT

from s2r_runtime.core.state import VERIFYING, certificate, job, unix_now
from s2r_runtime.messages import AnswerLate, RecorderChanged, Stopping, WallClockRead


def _clear(world: World) -> None:
    for reason in world.state.memory.latched:
        world.request("clear", text=reason)


EVENTS: dict[str, Letter] = {
    name: ALPHABET[name]
    for name in (
        "see",
        "see outside",
        "see nothing",
        "answer",
        "answer nan",
        "answer too much",
        "outsider",
        "outgrow",
        "alarm",
        "duty",
        "tick",
        "clock back",
        "died",
        "link down",
        "link up",
        "recorder down",
        "expire",
        "stop",
        "deploy",
        "undeploy",
        "revoke",
    )
}
EVENTS |= {
    "answer late": lambda world: world.feed(AnswerLate(world.t, world.state.asked.obs_seq if world.state.asked else 0)),
    "recorder up": lambda world: world.feed(RecorderChanged(world.t, ok=True)),
    "wall clock right": lambda world: world.feed(WallClockRead(world.t, 1500)),
    "clear": _clear,
}


def what_matters(world: World) -> tuple[Any, ...]:
    """What the document speaks of, and when it is the same."""
    s, settings = world.state, world.settings
    facts, memory, deployment = certificate(s), s.memory, s.deployment
    age = s.now_ns - s.observation_ns
    seen = "missing" if s.observation is None else "stale" if age > settings.observation_timeout_ns else "fresh"
    inside = s.observation is not None and abs(s.observation.x[0]) <= 1.6
    held = None if s.clear_since_ns is None else min(s.now_ns - s.clear_since_ns, settings.hysteresis_ns) // DT
    return (
        drawn(world),
        s.gate_reason,
        frozenset(memory.latched),
        (s.link_up, s.recorder_ok, s.stopping),
        None if deployment is None else (deployment.stage, deployment.running == deployment.digest),
        None if facts is None else (unix_now(s) < facts.expires_unix_s, memory.radius <= facts.verified_radius),
        (memory.gap is None, memory.gap is not None and memory.gap.epoch == memory.alarm_epoch),
        job(s, *VERIFYING) is not None,
        s.issuing is not None,
        (seen, inside, s.trouble),
        held,
        None if s.asked is None else (s.asked.source, s.now_ns - s.asked.t_ns > settings.command_ttl_ns),
        s.answered,
    )


def drawn(world: World) -> str:
    """The state of the picture."""
    s = world.state
    if s.stopping:
        return "ended"
    if s.memory.latched:
        return "latched"
    return "open" if s.gate_open else "closed" if s.clear_since_ns is None else "settling"


@cache
def explore() -> tuple[frozenset[tuple[Any, ...]], Counter[tuple[str, str]], int]:
    """The states that can be told apart, the arrows between those of the picture, and how many events the law has judged."""
    begin = chapter("driving", lockstep=False)
    seen, arrows, judged = {what_matters(begin)}, Counter[tuple[str, str]](), 0
    waiting = deque([begin])
    while waiting:
        world = waiting.popleft()
        for event in EVENTS.values():
            other = world.fork()
            other.events.clear()
            event(other)
            judged += len(other.events)
            arrows[drawn(world), drawn(other)] += 1
            matters = what_matters(other)
            if matters not in seen:
                seen.add(matters)
                waiting.append(other)
        ended = world.fork()
        ended.feed(Stopping(ended.t))
        arrows[drawn(world), drawn(ended)] += 1
    return frozenset(seen), arrows, judged


def picture() -> set[tuple[str, str]]:
    """The arrows that the document draws."""
    (text,) = re.findall(r"```mermaid\nstateDiagram-v2\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    return {(one, other) for one, other in re.findall(r"^ *([a-z]+) --> ([a-z]+)", text, re.MULTILINE)}


def test_no_state_that_can_be_reached_forwards_a_command_that_is_not_allowed_whatever_happens_in_it() -> None:
    states, arrows, judged = explore()  # every event was judged by the law on the way
    assert len(states) > 2000
    assert judged > len(states) * len(EVENTS) / 2
    opened = {state for state in states if state[0] == "open"}
    assert opened
    assert {state[1] for state in opened} == {"allowed"}
    assert not [state for state in states if state[0] != "open" and state[1] == "allowed"]
    assert arrows["settling", "open"]


def test_the_arrows_that_are_drawn_are_the_arrows_that_there_are() -> None:
    _, arrows, _ = explore()
    assert {arrow for arrow, count in arrows.items() if count and arrow[0] != arrow[1]} == picture()


def test_without_a_hysteresis_the_gate_opens_as_soon_as_everything_holds() -> None:
    """The one arrow that the picture leaves out: with `gate.hysteresis = 0` nothing settles."""
    rig = Rig(hysteresis_ns=0)
    rig.deployed()
    rig.observe((1.7, 0.0, 0.0))
    assert not rig.state.gate_open
    rig.observe()
    assert rig.state.gate_open
