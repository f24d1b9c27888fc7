"""The core's state, and `Turn`: one event's handling, from the state before it to the state and outputs after it.

A state is a frozen struct of plain data: comparable, and what msgspec can write. It holds no clock; `now_ns` is the latest
event's stamp.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import msgspec

from s2r_runtime.gate import Situation
from s2r_runtime.messages import (
    Answer,
    CertificateFacts,
    Gap,
    Memory,
    Observation,
    Output,
    Persist,
    Scenarios,
    Send,
    Settings,
    Source,
    Stretch,
    Struct,
)

NANO = 1_000_000_000


class Asked(Struct, frozen=True):
    """A source was asked about an observation and has not answered yet. `source`: controller or sampler."""

    source: Source
    obs_seq: int
    t_ns: int


class Campaign(Struct, frozen=True):
    """A campaign that samples, or given inputs that are driven. `running`: its source has started. `inputs`: their digest; then epoch is 0,
    and n, taken count rows. retry: it is repeated once if its samples depend on each other.
    """

    epoch: int
    n: int
    request_id: int
    running: bool = False
    taken: int = 0
    inputs: str = ""
    retry: bool = False


class Deployment(Struct, frozen=True):
    """The one controller that drives or is to drive. `running`: digest of what really runs, empty until it does.

    verifying: until it has a certificate; starting: until its process answers. `request_id` 0: its request was answered. scenarios: of a
    comparison; begun: it was shown the first of them.
    """

    digest: str
    request_id: int
    stage: Literal["verifying", "starting", "running"]
    certificate_id: str = ""
    running: str = ""
    scenarios: Scenarios | None = None
    begun: bool = False


class Job(Struct, frozen=True):
    """What the worker does. `again`: the radius outgrew a verification of the same request before.

    radius: the most that is asked for; least_radius: the least that will do.

    reverify: of the driving controller, whose certificate `certificate_id` the radius has outgrown. trace: of the model `digest`
    in `stretch`. retry: as in `Campaign`.
    """

    id: int
    purpose: Literal["gap", "trace", "deploy", "verify", "reverify"]
    request_id: int
    epoch: int
    digest: str = ""
    attempt: int = 0
    radius: float = 0.0
    hold_radius: float = 0.0
    certificate_id: str = ""
    again: bool = False
    stretch: Stretch = "campaign"
    least_radius: float = 0.0
    retry: bool = False
    seed: int | None = None
    """Of a verification, once it is drawn (rules 5). fixed: by a simulation."""
    fixed: bool = False


class Run(Struct, frozen=True):
    """A run in progress, or about to begin (`core.runs`). open: the gate is. shown: the controller saw the scenario's beginning;
    settled: the gate was open then.

    from_start: the controller's command was the first in it; None: none was sent yet. took_over: one of its commands was sent. closed: why
    the gate closed in it; said: why it was closed last; failed: how the controller did. index, steps, safety, below: as last scored.
    """

    controller: str
    certificate: str
    index: int = 0
    open: bool = False
    shown: bool = False
    settled: bool = False
    from_start: bool | None = None
    took_over: bool = False
    closed: str = ""
    said: str = ""
    failed: str = ""
    steps: int = 0
    safety: float | None = None
    below: bool = False


VERIFYING = ("deploy", "verify", "reverify")


CLOCK_ROUNDING_S = 2
"""Readings are whole seconds, and come now and then."""


class State(Struct, frozen=True):
    """All that the core knows.

    unix_s was believed at unix_ns, when read_unix_s was read (`core.wall_clock`).
    `observation`, `observation_ns`: newest usable one and when it came; `trouble`: why the newest is
    not usable, or empty; seen_seq: of the newest, usable or not; odd_seq: of one that came out of order. control_seq,
    control_stamp_ns: of the newest control instant; due_ns: grid point of the next one; report_ns: between the last two observations (both
    by the robot's stamps); `answered`: whether the newest instant has its Send. `idle`: recovery instants since a source
    was asked. `repeats`: of an observation whose command was sent. `issuing`: the job whose certificate is being signed.
    gate_said: the reason last recorded; `ended`: why the last deployment ended. clear_since_ns: since when all standing
    conditions of the gate hold. driven: a controller has, since the gap came into force; excited: given inputs were. trace_due_ns: when a
    growth of the gap is to be traced; traced_radius: the radius when one was traced last. `fault`: what was wrong with the last faulty
    observation; `faulty`: whether none that is good came since; fault_level: see `core.faults`. unsaved: the memory holds what was not
    persisted yet; saved_e_value: the watch's in what was.
    """

    settings: Settings | None = None
    memory: Memory = Memory(robot="", schema=0)
    refusal: str = ""
    stopping: bool = False
    now_ns: int = 0
    unix_s: int = 0
    unix_ns: int = 0
    read_unix_s: int = -1
    link_up: bool = False
    recorder_ok: bool = True
    recorder_late: bool = False
    """It is not ok for one reason only: the disk is slow."""
    analytics_up: bool = True
    observation: Observation | None = None
    observation_ns: int = 0
    trouble: str = ""
    seen_seq: int | None = None
    odd_seq: int | None = None
    control_seq: int | None = None
    control_stamp_ns: int | None = None
    due_ns: int = 0
    report_ns: int = 0
    answered: bool = True
    asked: Asked | None = None
    idle: int = 0
    repeats: int = 0
    send_seq: int = 0
    sent: Send | None = None
    controller_seq: int = -1
    sampler_seq: int = -1
    permit_until_ns: int | None = None
    campaign: Campaign | None = None
    deployment: Deployment | None = None
    jobs: tuple[Job, ...] = ()
    issuing: Job | None = None
    next_job: int = 1
    gate_open: bool = False
    gate_reason: str = "not_started"
    gate_said: str = "not_started"
    ended: str = ""
    clear_since_ns: int | None = None
    faults: int = 0
    episodes: int = 0
    driven: bool = False
    excited: bool = False
    trace_due_ns: int | None = None
    traced_radius: float = 0.0
    fault: str = ""
    fault_level: float = 0.0
    faulty: bool = False
    unsaved: bool = False
    saved_e_value: float = 1.0
    run: Run | None = None

    @property
    def e_value(self) -> float:
        """The watch's, in this epoch."""
        return self.memory.watch_e_value

    @property
    def measured(self) -> int:
        """Discrepancies that the watch counted in this epoch."""
        return self.memory.watch_n

    @property
    def clock_behind_s(self) -> int:
        """How far the clock is behind the time that is believed, s; 0 for what its own rounding makes."""
        behind = self.unix_s - self.read_unix_s if self.read_unix_s >= 0 else 0
        return behind if behind > CLOCK_ROUNDING_S else 0


def certificate(state: State) -> CertificateFacts | None:
    """The certificate that the deployment rests on."""
    wanted = state.deployment.certificate_id if state.deployment else ""
    return next((facts for facts in state.memory.certificates if facts.id == wanted), None)


def usable_gap(state: State) -> Gap | None:
    """The gap in force, unless the watch refuted it."""
    gap = state.memory.gap
    return gap if gap is not None and gap.epoch != state.memory.alarm_epoch else None


def job(state: State, *purposes: str) -> Job | None:
    """The running job of one of these purposes; a certificate that is being signed counts as its verification."""
    jobs = (*state.jobs, *(() if state.issuing is None else (state.issuing,)))
    return next((one for one in jobs if one.purpose in purposes), None)


def unix_now(state: State) -> int:
    """The wall clock: the last reading, carried on by the monotonic clock where that is the host's (not in lockstep)."""
    if state.settings is None or state.settings.lockstep:
        return state.unix_s
    return state.unix_s + max(0, state.now_ns - state.unix_ns) // NANO


def situation(state: State) -> Situation:
    """What the gate is to look at."""
    memory, deployment, gap = state.memory, state.deployment, state.memory.gap
    asked = state.asked
    return Situation(
        clock_ns=state.now_ns,
        unix_s=unix_now(state),
        stopping=state.stopping,
        latched=memory.latched,
        recorder_ok=state.recorder_ok,
        link_up=state.link_up,
        permit_until_ns=state.permit_until_ns,
        campaign_running=state.campaign is not None and state.campaign.running,
        controller_digest=deployment.running if deployment is not None and deployment.stage == "running" else None,
        analytics_up=state.analytics_up,
        alarmed=gap is not None and gap.epoch == memory.alarm_epoch,
        verifying=deployment is not None and (deployment.stage == "verifying" or job(state, "reverify") is not None),
        certificate=certificate(state),
        revoked=deployment is not None and deployment.certificate_id in memory.revoked,
        model_digest=memory.model_digest,
        epoch=0 if gap is None else gap.epoch,
        radius=math.inf if gap is None else memory.radius,
        faults=state.faults,
        observation=state.observation,
        observation_ns=state.observation_ns,
        trouble=state.trouble,
        asked_seq=None if asked is None else asked.obs_seq,
        asked_ns=0 if asked is None else asked.t_ns,
        last_command_seq=state.sampler_seq if asked is not None and asked.source == "sampler" else state.controller_seq,
        clear_since_ns=state.clear_since_ns,
    )


class Turn:
    """One event being handled: `state` so far, `outputs` in the order in which they take effect. Lives for one call of `handle`."""

    __slots__ = ("_soon", "_unsaved", "now", "outputs", "settings", "state")

    def __init__(self, state: State, settings: Settings, now_ns: int) -> None:
        self.state, self.settings, self.now = state, settings, now_ns
        self.outputs: list[Output] = []
        self._unsaved = self._soon = False

    @property
    def memory(self) -> Memory:
        """What outlives a restart."""
        return self.state.memory

    def set(self, **changes: Any) -> None:
        """Changes fields of the state."""
        self.state = msgspec.structs.replace(self.state, **changes)

    def remember(self, **changes: Any) -> None:
        """Changes fields of the memory; persisted at the latest with this event's last output."""
        self.set(memory=msgspec.structs.replace(self.state.memory, **changes))
        self._unsaved = True

    def remember_later(self, **changes: Any) -> None:
        """As `remember`, but nothing that moves the robot has to wait for the disk: persisted once nothing drives, or with what is next."""
        self.set(memory=msgspec.structs.replace(self.state.memory, **changes), unsaved=True)

    def remember_soon(self, **changes: Any) -> None:
        """As `remember`, but nothing waits for the disk: it is in the log at once, and the state folder follows."""
        self.set(memory=msgspec.structs.replace(self.state.memory, **changes))
        self._soon = True

    def persist(self) -> None:
        """What was remembered is durable before what is emitted after this, but for what is remembered soon."""
        if self.state.unsaved and not self.state.gate_open and self.state.campaign is None:
            self._unsaved = True
        if self._soon and not self._unsaved:
            self._soon = False
            self.outputs.append(Persist(self.now, self.state.memory, later=True))
        if self._unsaved:
            self._unsaved = self._soon = False
            self.set(unsaved=False, saved_e_value=self.state.memory.watch_e_value)
            self.outputs.append(Persist(self.now, self.state.memory))

    def emit(self, *outputs: Output) -> None:
        """Adds outputs."""
        self.outputs.extend(outputs)

    def answer(self, request_id: int, exit_code: int, text: str, *, final: bool = True) -> None:
        """Replies to a request (0: there is none to reply to)."""
        if request_id:
            self.outputs.append(Answer(self.now, request_id, exit_code, text, final))

    def add_job(self, one: Job) -> None:
        """Notes a job that a StartJob goes out for."""
        self.set(jobs=(*self.state.jobs, one), next_job=one.id + 1)

    def drop_job(self, one: Job) -> None:
        """Forgets a job."""
        self.set(jobs=tuple(other for other in self.state.jobs if other.id != one.id))
