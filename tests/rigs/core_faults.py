"""Faults in the core, one case after the other: what is injected, whether anything moved that may not, and whether it mends.

A case begins in one of the chapters (`core_chapters`): sampling, verifying, driving, asked, outgrown. One to three faults come, each an
event that is spoiled, missing, late, repeated, of another attempt or out of order; `core_law.Law` judges every event. Then the cause goes:
the robot, the daemon and the person do what they should, and a certified controller must drive again within `WITHIN` events, the gate's
reason being one of the table's all the time.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
from core_chapters import ALPHABET, CHAPTERS, chapter
from core_law import DT
from core_rig import S
from core_world import World
from hostile import spoiled

from s2r_runtime import gate
from s2r_runtime.messages import (
    AnalyticsChanged,
    AnswerLate,
    CampaignFinished,
    CertificateFailed,
    CertificatesDistrusted,
    CertificateStored,
    Command,
    EpisodeEnded,
    Event,
    InputsFinished,
    IssueCertificate,
    JobFinished,
    LinkChanged,
    Measured,
    Observation,
    Observed,
    Proposed,
    RecorderChanged,
    Requested,
    SampleTaken,
    Send,
    SourceStarted,
    SourceStopped,
    StartController,
    Started,
    StartJob,
    Stopping,
    Ticked,
    WallClockRead,
)

WITHIN = 220
"""Events from the last fault to a controller that drives; a campaign, a verification and the hysteresis are among them."""


DEPLOY_AGAIN = ("certificate_revoked", "no_certificate", "certificate_expired", "digest_mismatch")
"""The document: these go away when a controller is deployed again."""


@dataclass
class Outcome:
    """What a case came to. events: until a controller drove again."""

    faults: list[str]
    reasons: list[str]
    events: int


@cache
def beginnings() -> tuple[World, ...]:
    """A world in each chapter."""
    return tuple(chapter(name, lockstep=lockstep) for name, lockstep in CHAPTERS)


def run_case(seed: int, number: int) -> Outcome:
    """One case; AssertionError if the law was broken or it does not mend."""
    rng = random.Random(f"{seed}/{number}")
    world = beginnings()[number % len(beginnings())].fork()
    world.rng.seed(rng.random())
    faults, reasons = [], []
    for _ in range(rng.randint(1, 3)):
        name = rng.choice(NAMES)
        FAULTS[name](world, rng)
        faults.append(name)
        reasons.append(named(world))
    return Outcome(faults, reasons, mend(world))


def named(world: World) -> str:
    """The gate's reason; one of the table's, whatever happens."""
    reason = world.state.gate_reason
    bare, _, held = reason.partition(":")
    assert bare == gate.ALLOWED or bare in gate.REASONS, reason
    assert not held or held in gate.REASONS, reason
    assert (reason == gate.ALLOWED) == world.state.gate_open
    return reason


# ---------------------------------------------------------------- what should come next, and what comes instead


def next_event(world: World, rng: random.Random) -> Event:
    """What would happen now if nothing were wrong, or one of the things that could."""
    if world.ask is not None and rng.random() < 0.5:
        return answer(world)
    if world.duties and rng.random() < 0.6:
        return done(world)
    if rng.random() < 0.4:
        return observation(world)
    t, gap, campaign = world.t, world.state.memory.gap, world.campaign
    epoch = 1 if gap is None else gap.epoch
    digest = "" if world.state.deployment is None else world.state.deployment.digest
    found: list[Event] = [
        Ticked(t + DT // 5),
        WallClockRead(t, 1500),
        Measured(t, world.seq, 0.001, "", 1.0, 1, 0, epoch),
        EpisodeEnded(t, 1, 10, 0.1, 1.0),
        SampleTaken(t, epoch, 3, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1),
        CampaignFinished(t, epoch, 3 if campaign is None else campaign.n, True, {}),
        InputsFinished(t, "inputs", 5, True),
        SourceStarted(t, "controller", digest),
        SourceStarted(t, "sampler", ""),
        SourceStopped(t, "controller", "finished"),
        CertificateFailed(t, "no key", world.requests),
        LinkChanged(t, True),
        RecorderChanged(t, True),
        RecorderChanged(t, False, late=True),
        AnalyticsChanged(t, True),
        AnswerLate(t, world.seq),
    ]
    return rng.choice(found)


def answer(world: World) -> Event:
    """A good answer to what is asked."""
    assert world.ask is not None
    world.numbers += 1
    return Proposed(world.t, Command(world.numbers, world.t, world.ask.source, (0.1, 1.0), world.ask.obs_seq, 2 * DT))


def observation(world: World) -> Event:
    """A good one."""
    world.t += DT
    world.seq += 1
    world.recent = Observation(world.seq, world.t, (0.5, 0.2, 0.0))
    return Observed(world.t, world.recent)


def done(world: World) -> Event:
    """The first duty of the daemon, done well."""
    kept: list[Event] = []
    other = world.fork()
    other.rng.seed(1)  # 0.13, 0.85: the first duty, done well
    other.feed = kept.append  # type: ignore[method-assign]
    other.duty()
    world.duties = other.duties
    return kept[0]


def _spoiled(world: World, rng: random.Random) -> None:
    event = next_event(world, rng)
    for _ in range(rng.choice([1, 1, 1, 2])):
        event = spoiled(rng, event, keep=("gap",) if isinstance(event, CertificateStored) else ())
    world.feed(event)


def _swapped(world: World, rng: random.Random) -> None:
    """Two events the other way round."""
    one = next_event(world, rng)
    other = next_event(world, rng)
    world.feed(msgspec.structs.replace(other, t_ns=max(one.t_ns, other.t_ns)))
    world.feed(msgspec.structs.replace(one, t_ns=max(one.t_ns, other.t_ns)))


def _repeated(world: World, rng: random.Random) -> None:
    """Something that happened before happens once more, as it was or as if it were new; a request has a new number."""
    past = [event for event, _ in world.events if not isinstance(event, Requested | Started | Stopping)]
    event = rng.choice(past)
    world.feed(event if rng.random() < 0.3 else msgspec.structs.replace(event, t_ns=world.t))


def _withheld(world: World, rng: random.Random) -> None:
    """Nothing but time for a while."""
    for _ in range(rng.choice([1, 2, 5, 30])):
        world.t += rng.choice([DT // 5, DT, 3 * DT])
        world.feed(Ticked(world.t))


def _clock(world: World, rng: random.Random) -> None:
    """The monotonic clock steps, and may step back."""
    step = rng.choice([1, DT // 10, DT, 10 * S, 10**6 * S]) * rng.choice([-1, 1])
    world.feed(Ticked(world.t + step))
    if rng.random() < 0.5:
        world.t += step


def _wall_clock(world: World, rng: random.Random) -> None:
    world.feed(WallClockRead(world.t, 1500 + rng.choice([-1, 1]) * rng.choice([1, 99, 100, 301, 1000, 10**9])))


def _of_another_attempt(world: World, rng: random.Random) -> None:
    """A worker's result, as good as it can be, but not of what was asked."""
    t, memory = world.t, world.state.memory
    order = StartJob(t, world.state.next_job + rng.choice([-2, -1, 0, 1]), "verify", memory.epochs, "c1", 0.02, 0.2, 1, 1, 0.01)
    order = msgspec.structs.replace(order, attempt=max(1, memory.attempts + rng.choice([-1, 0, 1])))
    result = world.verification(order, bad=False)
    job = rng.choice([order.job_id, *(one.id for one in world.state.jobs)])
    world.feed(JobFinished(t, job, "verify", verification=result))


def _certificate(world: World, rng: random.Random) -> None:
    """A certificate that was not asked for, or is not as it was asked for: every field of it, in turn."""
    facts = rng.choice(world.state.memory.certificates) if world.state.memory.certificates else None
    waiting = [one for one in world.duties if isinstance(one, IssueCertificate)]
    if waiting:
        event = done(world)
        assert isinstance(event, CertificateStored)
        world.feed(msgspec.structs.replace(event, facts=spoiled(rng, event.facts)))
    elif facts is not None:
        gap = world.state.memory.gap
        changed = spoiled(rng, gap) if rng.random() < 0.5 else gap
        requests = rng.choice([0, world.requests])
        world.feed(CertificateStored(world.t, spoiled(rng, facts) if rng.random() < 0.7 else facts, changed, requests))


def _distrusted(world: World, rng: random.Random) -> None:
    """The key of a certificate in force is revoked; or of one that nobody knows."""
    known = [facts.id for facts in world.state.memory.certificates]
    world.feed(CertificatesDistrusted(world.t, {rng.choice([*known, "nobody's"]): "revoked"}))


def _impostor(world: World, rng: random.Random) -> None:
    """A command from somebody who was not asked, with everything right but that."""
    seq = world.seq if world.ask is None else world.ask.obs_seq
    source: Any = rng.choice(["external", "recovery", "controller", "sampler", "CONTROLLER", ""])
    world.numbers += 1
    world.feed(Proposed(world.t, Command(world.numbers, world.t, source, (0.1, 1.0), seq, 2 * DT)))


def _letter(name: str) -> Callable[[World, random.Random], None]:
    return lambda world, _: ALPHABET[name](world)


FAULTS: dict[str, Callable[[World, random.Random], None]] = {
    "an event spoiled": _spoiled,
    "two events swapped": _swapped,
    "an event repeated": _repeated,
    "nothing happens": _withheld,
    "the clock steps": _clock,
    "the wall clock steps": _wall_clock,
    "a result of another attempt": _of_another_attempt,
    "another certificate": _certificate,
    "a key is revoked": _distrusted,
    "an impostor commands": _impostor,
} | {name: _letter(name) for name in ALPHABET if name not in ("see", "duty", "answer", "deploy", "sample", "permit", "clear", "repeat")}
NAMES = ["an event spoiled"] * 12 + ["another certificate", "an event repeated", "a result of another attempt"] * 3 + list(FAULTS)


# ---------------------------------------------------------------- the cause goes


def mend(world: World) -> int:
    """Everybody does what they should; events until a controller drives."""
    begun = len(world.events)
    if world.state.stopping or world.state.refusal:
        world.restart(orderly=False)
    world.t = max(world.t, S) + 10 * DT  # what was in flight is over
    world.duties = tuple(one for one in world.duties if _still_wanted(world, one))
    for event in (
        LinkChanged(world.t, True),
        RecorderChanged(world.t, True),
        AnalyticsChanged(world.t, True),
        WallClockRead(world.t, 1500),
    ):
        world.feed(event)
    world.numbers = max(world.numbers, world.state.controller_seq, world.state.sampler_seq)
    sent = 0
    while len(world.events) - begun < WITHIN:
        _one_good_event(world)
        named(world)
        driven = [one for one in world.events[-1][1] if isinstance(one, Send) and one.source == "controller"]
        sent += len(driven)
        if sent >= 2 and world.state.gate_open:
            return len(world.events) - begun
    raise AssertionError(f"does not mend: {world.state.gate_reason}")


def _still_wanted(world: World, duty: Any) -> bool:
    """A daemon that works does each of its duties; one that restarted has none of the last run's."""
    if isinstance(duty, StartJob):
        return any(one.id == duty.job_id for one in world.state.jobs)
    if isinstance(duty, IssueCertificate):
        return world.state.issuing is not None
    if isinstance(duty, StartController):
        return world.state.deployment is not None and world.state.deployment.stage == "starting"
    return world.state.campaign is not None and not world.state.campaign.running


def _one_good_event(world: World) -> None:
    state, memory = world.state, world.state.memory
    campaign, deployment = state.campaign, state.deployment
    if world.ask is not None and state.asked is not None:
        world.feed(answer(world))
    elif world.duties:
        world.feed(done(world))
    elif state.asked is not None and not state.settings.lockstep:  # type: ignore[union-attr]
        world.t += DT
        world.feed(Ticked(world.t))
    elif state.jobs:
        lost = state.jobs[0]
        kind: Any = {"gap": "gap", "trace": "trace"}.get(lost.purpose, "verify")
        world.feed(JobFinished(world.t, lost.id, kind, error="the worker was lost"))
    elif state.issuing is not None:
        world.feed(CertificateFailed(world.t, "no key", state.issuing.request_id))
    elif memory.latched:
        world.request("clear", text=memory.latched[0])
    elif campaign is not None and not campaign.running:
        world.request("cancel")
    elif campaign is not None and campaign.inputs:
        world.feed(InputsFinished(world.t, campaign.inputs, campaign.n, True))
    elif campaign is not None and world.campaign is not None and world.rng.random() < 0.3:
        world.finish_campaign()
    elif deployment is None and campaign is None and not state.jobs and state.observation is not None and not state.trouble:
        _towards_a_deployment(world)
    elif deployment is not None and (deployment.stage == "starting" or state.gate_reason in DEPLOY_AGAIN):
        world.request("undeploy")
    else:
        _see(world)


def _towards_a_deployment(world: World) -> None:
    """Whatever is missing: a permit, a campaign, a controller; an observation in between."""
    state, memory = world.state, world.state.memory
    gap = memory.gap
    lost = gap is None or gap.epoch == memory.alarm_epoch or not memory.radius < 1e6
    fresh = state.now_ns - state.observation_ns <= state.settings.observation_timeout_ns  # type: ignore[union-attr]
    if not fresh or world.rng.random() < 0.3:
        _see(world)
    elif lost and (state.permit_until_ns is None or state.permit_until_ns <= world.t + 100 * DT):
        world.request("permit", duration_s=3600.0)
    elif lost:
        world.request("sample")
    else:
        world.request("deploy", digest="c1")


def _see(world: World) -> None:
    """The robot is seen; in lockstep it waits for its command and repeats itself until that comes."""
    state, recent = world.state, world.recent
    if state.settings is not None and state.settings.lockstep and recent is not None:
        waits = world.law.last is None or world.law.last.obs_seq != recent.seq
        silent = state.idle >= state.settings.settle_periods
        if (waits or silent) and world.repeats < 3:
            world.repeats += 1
            world.feed(Observed(world.t, recent))
            return
    world.repeats = 0
    world.feed(observation(world))
