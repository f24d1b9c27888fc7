"""A world for the core to walk through: robot, daemon, workers and operator, all of them at times broken or hostile."""

from __future__ import annotations

import copy
import math
import random
from collections import Counter
from typing import Any

import msgspec
from core_law import DT, FAULTS, WALK, Law
from core_rig import GAP, S

from s2r_runtime.core import driven, ledger, wall_clock
from s2r_runtime.core import reducer as core
from s2r_runtime.core.headroom import grid
from s2r_runtime.core.state import unix_now
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
    AnalyticsChanged,
    Ask,
    CampaignFinished,
    CertificateFacts,
    CertificateFailed,
    CertificateStored,
    Command,
    DrawSeed,
    Event,
    GateChanged,
    InputsFinished,
    IssueCertificate,
    JobFinished,
    LawResult,
    LinkChanged,
    Measured,
    Memory,
    Observation,
    Observed,
    Output,
    OverrideChanged,
    Persist,
    Proposed,
    RecorderChanged,
    Requested,
    SampleTaken,
    SeedDrawn,
    Send,
    SourceStarted,
    SourceStopped,
    StartCampaign,
    StartController,
    Started,
    StartInputs,
    StartJob,
    StopCampaign,
    Stopping,
    Ticked,
    Verification,
    WallClockRead,
)

# ---------------------------------------------------------------- the world


class World:
    """Robot, daemon, workers and operator, mostly doing what they should. `feed` hands an event to core and law."""

    def __init__(self, seed: int, *, lockstep: bool, tracing: bool = True) -> None:
        self.rng = random.Random(seed)
        self.settings = msgspec.structs.replace(WALK, lockstep=lockstep, recovery=self.rng.choice(["stop", "hold", "return"]))
        if tracing:
            traces = random.Random(seed)
            often: dict[str, Any] = {n: traces.random() < 0.5 for n in ("trace_after_campaign", "trace_after_inputs", "trace_on_growth")}
            self.settings = msgspec.structs.replace(self.settings, adopt=traces.choice(["ask", "always"]), trace_delay_ns=5 * DT, **often)
        self.law, self.state = Law(self.settings), core.initial()
        self.t, self.seq, self.numbers, self.requests = S, 0, 0, 0
        self.ask: Ask | None = None
        self.campaign: StartCampaign | None = None
        self.inputs: StartInputs | None = None
        self.duties: tuple[Output, ...] = ()
        self.memory = Memory("r", MEMORY_SCHEMA)
        self.recent: Observation | None = None
        self.repeats = 0
        """How often the robot has repeated it, waiting for its command."""
        self.events: list[tuple[Event, tuple[Output, ...]]] = []
        self.seen: Counter[str] = Counter()
        self.lost: frozenset[int] = frozenset()
        """Requests whose daemon was killed before it could answer."""

    def fork(self) -> World:
        """The same world, to go another way from here."""
        other = copy.copy(self)
        other.law, other.events, other.seen = copy.copy(self.law), list(self.events), Counter(self.seen)
        other.rng = random.Random()
        other.rng.setstate(self.rng.getstate())
        return other

    def feed(self, event: Event) -> None:
        before = self.state
        self.state, outputs = core.handle(before, event)
        self.events.append((event, outputs))
        self.law.judge(event, outputs)
        for output in outputs:
            self._take(output)
        if isinstance(event, Stopping):
            self.ask, self.campaign, self.inputs, self.duties = None, None, None, ()

    def _take(self, output: Output) -> None:
        kind = type(output).__name__
        self.seen[f"{kind}/{output.source}" if isinstance(output, Send) else kind] += 1
        match output:
            case Ask():
                self.ask = output
            case Send():
                self.ask = None
            case StartCampaign():
                self.campaign = output
                self.duties = (*self.duties, output)
            case StartInputs():
                self.inputs = output
                self.duties = (*self.duties, output)
            case StopCampaign():
                self.campaign = self.inputs = None
            case DrawSeed() | StartJob() | IssueCertificate() | StartController():
                self.duties = (*self.duties, output)
            case Persist():
                self.memory = output.memory
            case GateChanged(open=True):
                self.seen["opened"] += 1
            case _:
                pass

    # ------------------------------------------------------------------ one event

    def step(self) -> None:
        """Something happens."""
        rng = self.rng
        if self.ask is not None and rng.random() < 0.8:
            self.feed(self.answer())
        elif self.duties and rng.random() < 0.4:
            self.duty()
        else:
            kind = rng.choices(["observe", "tick", "measure", "operate", "chaos"], [60, 12, 10, 14, 4])[0]
            getattr(self, kind)()

    def restart(self, *, orderly: bool) -> None:
        """The daemon goes down, and comes up with what is on the disk."""
        if orderly:
            self.feed(Stopping(self.t))
            assert self.law.requests - self.law.final <= self.lost, "a request without its answer"
        self.lost |= self.law.requests - self.law.final
        self.state, self.ask, self.campaign, self.inputs, self.duties = core.initial(), None, None, None, ()
        self.begin()

    def begin(self) -> None:
        """A run starts."""
        self.events.clear()
        in_force = self.memory.model_digest or self.settings.model_digest  # as the daemon has it, from its model store
        self.feed(Started(self.t, 1500, msgspec.structs.replace(self.settings, model_digest=in_force), self.memory))
        self.feed(LinkChanged(self.t, up=True))

    def later(self, step: int) -> int:
        """Time as the daemon sees it: the robot's in lockstep."""
        if not self.settings.lockstep:
            self.t += step
        return self.t

    def observe(self) -> None:
        rng, lockstep = self.rng, self.settings.lockstep
        waits = lockstep and self.recent is not None and (self.law.last is None or self.law.last.obs_seq != self.recent.seq)
        if self.recent is not None and rng.random() < (0.9 if waits else 0.05):
            self.feed(Observed(self.later(DT // 10), self.recent))
            return
        step = rng.choices([DT, DT // 2, DT // 20, 4 * DT, 7 * DT], [80, 8, 4, 4, 2])[0]
        self.t += step
        self.seq += 1
        scale = rng.choices([0.9, 1.04, 1.9], [96, 2, 2])[0]
        x = (scale * 1.6 * rng.choice([-1, 1]), scale * rng.uniform(-1, 1), rng.uniform(-9, 9))
        self.recent = Observation(self.seq, self.t, x)
        self.feed(Observed(self.t, self.recent))

    def answer(self) -> Event:
        rng, ask = self.rng, self.ask
        assert ask is not None
        if rng.random() < 0.02:
            return SourceStopped(self.later(1), ask.source, rng.choice(FAULTS))  # type: ignore[arg-type]
        self.numbers += 1
        t = self.later(rng.choice([1, DT // 10, DT // 2]))
        command = Command(self.numbers, t, ask.source, (rng.uniform(-0.2, 0.2), rng.uniform(-3, 3)), ask.obs_seq, 2 * DT)
        if rng.random() < 0.06:
            command = msgspec.structs.replace(command, **rng.choice(WRONG))
        return Proposed(t, command)

    def tick(self) -> None:
        step = self.rng.choices([DT // 5, DT, 6 * DT, 100 * S], [80, 10, 9, 1])[0]
        self.feed(Ticked(self.later(step)))

    def measure(self) -> None:
        rng = self.rng
        gap = self.state.memory.gap
        d = rng.choices([0.5, 1.2, 1.6, 4.0], [90, 6, 3, 1])[0] * (0.01 if gap is None else self.state.memory.radius)
        event = Measured(self.t, self.seq, min(d, 1e6), "", rng.choices([1.0, 1e3], [99, 1])[0], 1, 0)
        if rng.random() < 0.15:
            event = msgspec.structs.replace(event, **rng.choice([{"fault": "jump"}, {"e_value": math.nan}, {"epoch": 99, "e_value": 1e9}]))
        self.feed(event)

    def request(self, verb: Any, **fields: Any) -> None:
        self.requests += 1
        self.feed(Requested(self.t, self.requests, verb, 1, **fields))

    def operate(self) -> None:
        """Mostly what brings the story forward."""
        rng, state = self.rng, self.state
        if rng.random() < 0.12:
            verb = rng.choice(["undeploy", "revoke", "adopt", "cancel", "stop", "trace"])
            self.request(verb, digest="model", text=rng.choice(["", "drive", "inputs"]) if verb == "trace" else "")
        elif state.memory.latched:
            self.request("clear", text=rng.choice(state.memory.latched))
        elif state.clock_behind_s and rng.random() < 0.5:
            self.request("clear", text=wall_clock.REASON)
        elif state.settings is not None and driven.refusal(state.memory, state.settings) and rng.random() < 0.5:
            self.request("clear", text=driven.REASON)
        elif state.permit_until_ns is None or state.permit_until_ns <= self.t:
            self.request("permit", duration_s=rng.choice([0.0, 1.0, 3.0, 60.0, math.nan]))
        elif state.memory.gap is None or state.memory.alarm_epoch or state.memory.campaign_epoch:
            self.request("sample") if rng.random() < 0.7 else self.request("excite", digest="inputs", count=5)
        elif self.campaign is not None:
            self.sample()
        elif state.deployment is None:
            self.request("deploy", digest=rng.choice(["c1", "c1", "c2"]))
        else:
            self.request(rng.choice(["verify", "permit"]), digest="c2", duration_s=9.0)
        if self.campaign is not None or self.inputs is not None:
            self.sample()

    def sample(self) -> None:
        """The campaign goes on, or ends."""
        campaign = self.campaign
        if self.inputs is not None and self.rng.random() < 0.1:
            inputs, self.inputs = self.inputs, None
            self.feed(InputsFinished(self.t, inputs.digest, inputs.n, complete=self.rng.random() < 0.5))
        if campaign is None or self.rng.random() < 0.5:
            return
        if self.rng.random() < 0.5:
            self.feed(SampleTaken(self.t, campaign.epoch, 3, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1))
        elif self.rng.random() < 0.8:
            self.finish_campaign()
        else:
            self.campaign = None
            self.feed(CampaignFinished(self.t, campaign.epoch, 3, False, {}))

    def finish_campaign(self) -> None:
        """Every sample is there."""
        campaign, self.campaign = self.campaign, None
        if campaign is not None:
            self.feed(CampaignFinished(self.t, campaign.epoch, campaign.n, True, {}))

    def duty(self) -> None:
        """The daemon does what an output asked for; it may fail."""
        rng, index = self.rng, self.rng.randrange(len(self.duties))
        duty, bad = self.duties[index], self.rng.random() < 0.15
        self.duties = self.duties[:index] + self.duties[index + 1 :]
        match duty:
            case StartCampaign() | StartInputs():
                self.feed(SourceStopped(self.t, "sampler", "start_failed") if bad else SourceStarted(self.t, "sampler", ""))
            case StartController():
                digest = "another" if bad and rng.random() < 0.5 else duty.digest
                failed = SourceStopped(self.t, "controller", "start_failed")
                self.feed(failed if bad and digest == duty.digest else SourceStarted(self.t, "controller", digest))
            case DrawSeed():
                failed = JobFinished(self.t, duty.job_id, "verify", error="the state cannot be saved")
                self.feed(failed if bad else SeedDrawn(self.t, duty.job_id, duty.attempt, rng.getrandbits(48)))
            case StartJob(kind="gap"):
                n = self.state.memory.campaign_n
                model = self.state.memory.model_digest
                gap = msgspec.structs.replace(GAP, epoch=duty.epoch, n=n, epsilon=0.2, radius=rng.uniform(0.005, 0.02), model_digest=model)
                self.feed(JobFinished(self.t, duty.job_id, "gap", gap=None if bad else gap, error="killed" if bad else ""))
            case StartJob(kind="verify"):
                self.feed(JobFinished(self.t, duty.job_id, "verify", verification=self.verification(duty, bad)))
            case StartJob():
                found: dict[str, object] = {"verdict": "none"}
                if rng.random() < 0.3:
                    found = {"verdict": "traced", "proposal": {"digest": rng.choice(["model", "better"]), "proposed": True}}
                self.feed(JobFinished(self.t, duty.job_id, "trace", trace=None if bad else found, error="killed" if bad else ""))
            case IssueCertificate():
                v = duty.verification
                number = f"{v.attempt}/{duty.gap.epoch}"
                facts = CertificateFacts(
                    number,
                    v.controller_digest,
                    v.model_digest,
                    "task",
                    "profile",
                    duty.gap.epoch,
                    duty.gap.radius,
                    v.radius,
                    unix_now(self.state),
                    unix_now(self.state) + 100,
                    v.attempt,
                )
                self.feed(
                    CertificateFailed(self.t, "no key", duty.request_id) if bad else CertificateStored(self.t, facts, None, duty.request_id)
                )
            case _:
                raise AssertionError(duty)

    def verification(self, duty: StartJob, bad: bool) -> Verification:
        split = len(grid(duty.least_radius, duty.radius))
        n = ledger.sample_size(0.2, duty.beta / split)
        law = LawResult("uniform", n, -1.0 if bad else 0.1, int(bad), 0.5, 1.0, True, True, not bad)
        return Verification(
            not bad,
            duty.radius,
            duty.hold_radius,
            0.0,
            0.2,
            duty.beta,
            duty.attempt,
            duty.seed,
            (law,),
            duty.digest,
            self.state.memory.model_digest,
            "task",
            split=split,
        )

    def chaos(self) -> None:
        """What nobody ordered."""
        rng, t = self.rng, self.t
        recent = self.recent or Observation(1, 1, (0.0, 0.0, 0.0))
        command = Command(self.numbers, t, "controller", (0.1, 0.1), recent.seq, DT)
        choice = rng.randrange(16)
        if choice == 15:
            self.restart(orderly=rng.random() < 0.7)
        elif choice == 14 and rng.random() < 0.3:
            self.t -= rng.choice([1, DT])
            self.feed(Ticked(self.t))
        elif choice in (12, 13):
            up = choice == 12 or rng.random() < 0.5
            self.feed(rng.choice([LinkChanged(t, up), RecorderChanged(t, up), AnalyticsChanged(t, up)]))
            self.feed(LinkChanged(t, True))
        else:
            self.seq += 1  # what is unusable below has a number of its own
            self.feed(
                [
                    Proposed(t, msgspec.structs.replace(command, source=rng.choice(["external", "recovery"]))),  # type: ignore[list-item]
                    Proposed(t, command),
                    Proposed(t, msgspec.structs.replace(command, source="sampler")),
                    SourceStarted(t, "controller", rng.choice(["c1", "another"])),
                    SourceStopped(t, "controller", rng.choice(["died", "finished"])),
                    SourceStarted(t, "sampler", ""),
                    Observed(t, Observation(self.seq, t + 1, (math.nan, 0.0, 0.0))),
                    Observed(t, Observation(rng.choice([0, recent.seq + 9]), rng.choice([0, 10**15]), (), "malformed")),
                    Observed(t, Observation(max(0, recent.seq - 2), recent.stamp_ns - 2 * DT, (0.0, 0.0, 0.0))),
                    OverrideChanged(t, rng.choice(["emergency_stop", "manual_override"])),  # type: ignore[arg-type]
                    RecorderChanged(t, True),
                    AnalyticsChanged(t, True),
                ][choice % 12]
            )
            self.feed(WallClockRead(t, rng.choice([1500, 1501, 1700])) if rng.random() < 0.1 else WallClockRead(t, 1500))


WRONG: list[dict[str, Any]] = [
    {"u": (math.nan, 0.0)},
    {"u": (0.0,)},
    {"u": (0.3, 0.0)},
    {"u": (0.0, -math.inf)},
    {"fault": "raised"},
    {"obs_seq": 0},
    {"seq": 0},
    {"t_ns": 0},
    {"t_ns": 10**18},
    {"ttl_ns": -5},
    {"source": "external"},
]
