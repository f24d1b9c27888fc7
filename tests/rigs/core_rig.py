"""A daemon and a robot for the core, one call at a time, and the words to ask what came out."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import msgspec

from s2r_runtime.core import ledger
from s2r_runtime.core import reducer as core
from s2r_runtime.core.headroom import grid
from s2r_runtime.core.state import State
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
    RULES,
    Answer,
    CampaignFinished,
    CertificateFacts,
    CertificateStored,
    Command,
    DrawSeed,
    Event,
    Gap,
    IssueCertificate,
    JobFinished,
    LawResult,
    LinkChanged,
    Measured,
    Memory,
    Observation,
    Observed,
    Output,
    Proposed,
    Requested,
    SeedDrawn,
    Send,
    Settings,
    SourceStarted,
    StartCampaign,
    Started,
    StartJob,
    Verification,
)

S = 1_000_000_000
DT = 33_000_000
T = TypeVar("T")

SETTINGS = Settings(
    robot="r",
    states=("x", "y", "theta"),
    inputs=("v", "w"),
    angles=("theta",),
    dt_ns=DT,
    lockstep=False,
    region=((-1.6, 1.6), (-1.0, 1.0), (-math.pi, math.pi)),
    geofence=((-2.0, 2.0), (-1.5, 1.5), (-math.pi, math.pi)),
    input_bounds=((-0.2, 0.2), (-3.0, 3.0)),
    observation_timeout_ns=S // 5,
    command_ttl_ns=S // 10,
    hysteresis_ns=S // 10,
    settle_periods=5,
    latching=("watch_alarm", "controller_fault", "command_invalid", "measurement_faults"),
    recovery="stop",
    recovery_input=(0.0, 0.0),
    home=(0.0, 0.0, 0.0),
    model_name="unicycle",
    model_digest="model",
    task_digest="task",
    profile_digest="profile",
    epsilon=0.03,
    beta=0.05,
    discard=0,
    campaign_n=0,
    headroom=1.5,
    alpha=0.01,
    max_measurement_faults=2,
    certificate_lifetime_s=1000,
    seed=1,
    required_laws=("uniform", "persistent"),
    campaign_digest="campaign",
    norm_set="ball",
    norm_weights=(1.0, 1.0, 0.05),
    rules=RULES,
)
GAP = Gap(0.01, 0.1, 0.1, 50, "ball", (1.0, 1.0, 0.05), 160, 0, 0.03, 0.0152, 1, "model", "transitions")


class Rig:
    """A daemon and a robot, one call at a time. `feed` returns an event's outputs and keeps them in `outputs`."""

    def __init__(self, memory: Memory | None = None, *, start: bool = True, **changes: Any) -> None:
        self.settings = msgspec.structs.replace(SETTINGS, **changes)
        self.memory = memory or Memory("r", MEMORY_SCHEMA)
        self.state: State = core.initial()
        self.t, self.seq, self.numbers, self.requests = S, 0, 0, 0
        self.outputs: list[Output] = []
        self.draws = True
        if start:
            self.feed(Started(self.t, 1500, self.settings, self.memory))
            self.feed(LinkChanged(self.t, up=True))

    def feed(self, event: Event) -> list[Output]:
        before = msgspec.json.encode(self.state)
        after, outputs = core.handle(self.state, event)
        assert (after, outputs) == core.handle(self.state, event), "not a function of state and event"
        assert msgspec.json.encode(self.state) == before, "the state was changed"
        self.state = after
        self.outputs += outputs
        return [*outputs, *(more for output in outputs if isinstance(output, DrawSeed) for more in self._draw(output))]

    def _draw(self, order: DrawSeed) -> list[Output]:
        """As the daemon does at once, unless the test wants to."""
        return self.feed(SeedDrawn(self.t, order.job_id, order.attempt, 1000 + order.attempt)) if self.draws else []

    def request(self, verb: Any, **fields: Any) -> list[Output]:
        self.requests += 1
        return self.feed(Requested(self.t, self.requests, verb, 1000, **fields))

    def observe(self, x: tuple[float, ...] = (0.5, 0.2, 0.0), *, after: int = DT, **changes: Any) -> list[Output]:
        self.t += after
        self.seq += 1
        observation = Observation(self.seq, self.t, x)
        return self.feed(Observed(self.t, msgspec.structs.replace(observation, **changes)))

    def repeat(self) -> list[Output]:
        assert self.state.observation is not None
        return self.feed(Observed(self.t, self.state.observation))

    def propose(self, u: tuple[float, ...] = (0.1, 1.0), source: Any = "controller", **changes: Any) -> list[Output]:
        self.numbers += 1
        asked = self.state.asked
        command = Command(self.numbers, self.t, source, u, asked.obs_seq if asked else self.seq, S // 10)
        return self.feed(Proposed(self.t, msgspec.structs.replace(command, **changes)))

    def measure(self, discrepancy: float, *, e_value: float = 1.0, fault: str = "", **changes: Any) -> list[Output]:
        event = Measured(self.t, self.seq, discrepancy, fault, e_value, 10, 1)
        return self.feed(msgspec.structs.replace(event, **changes))

    # ------------------------------------------------------------------ whole chapters

    def sampling(self, count: int = 0) -> list[Output]:
        """As far as a campaign that runs."""
        self.observe()
        self.request("permit", duration_s=60.0)
        outputs = self.request("sample", count=count)
        self.feed(SourceStarted(self.t, "sampler", "settings"))
        return outputs

    def gap(self, **changes: Any) -> list[Output]:
        """As far as the end of a campaign's gap job."""
        order = one(self.sampling(), StartCampaign)
        self.feed(CampaignFinished(self.t, order.epoch, order.n, complete=True, rejected={}))
        found = msgspec.structs.replace(GAP, epoch=order.epoch, n=order.n, transitions_digest=f"transitions-{order.epoch}")
        return self.finish_gap(msgspec.structs.replace(found, **changes))

    def finish_gap(self, gap: Gap | None, error: str = "") -> list[Output]:
        return self.feed(JobFinished(self.t, self.state.next_job - 1, "gap", gap=gap, error=error))

    def verified(self, *, names: tuple[str, ...] = ("uniform", "persistent"), passed: bool = True, **changes: Any) -> list[Output]:
        """The running verification ends."""
        job = one(self.outputs, StartJob, last=True)
        result = msgspec.structs.replace(self.result(job, names=names, passed=passed), **changes)
        return self.feed(JobFinished(self.t, job.job_id, "verify", verification=result))

    def result(self, job: StartJob, *, names: tuple[str, ...] = ("uniform", "persistent"), passed: bool = True) -> Verification:
        """What the worker finds, at the most that was asked for."""
        split = len(grid(job.least_radius, job.radius))
        n = ledger.sample_size(0.03, ledger.share(0.05, job.attempt) / split)
        laws = tuple(LawResult(law, n, 0.1 if passed else -1.0, 0, 0.01, 1.0, True, True, passed) for law in names)
        beta, attempt, seed = job.beta, job.attempt, job.seed
        radii = job.radius, job.hold_radius
        return Verification(passed, *radii, 0.0, 0.03, beta, attempt, seed, laws, job.digest, "model", "task", split=split)

    def stored(self, **changes: Any) -> list[Output]:
        """The certificate that was asked for is durable."""
        order = one(self.outputs, IssueCertificate, last=True)
        v = order.verification
        facts = CertificateFacts(
            f"c{v.attempt}",
            v.controller_digest,
            "model",
            "task",
            "profile",
            order.gap.epoch,
            order.gap.radius,
            v.radius,
            1500,
            2500,
            v.attempt,
        )
        return self.feed(CertificateStored(self.t, msgspec.structs.replace(facts, **changes), request_id=order.request_id))

    def deploying(self, digest: str = "controller") -> list[Output]:
        """As far as a controller that is told to start."""
        self.request("deploy", digest=digest)
        self.verified()
        return self.stored()

    def deployed(self, digest: str = "controller") -> list[Output]:
        """As far as a controller that runs, gate not open yet."""
        self.gap()
        self.deploying(digest)
        return self.feed(SourceStarted(self.t, "controller", digest))

    def driving(self) -> None:
        """As far as an open gate."""
        self.deployed()
        for _ in range(8):
            self.observe()
            self.propose()
        assert self.state.gate_open


def of(outputs: list[Output], kind: type[T]) -> list[T]:
    return [output for output in outputs if isinstance(output, kind)]


def one(outputs: list[Output], kind: type[T], *, last: bool = False) -> T:
    found = of(outputs, kind)
    assert found
    assert last or len(found) == 1, found
    return found[-1]


def kinds(outputs: list[Output]) -> list[str]:
    return [type(output).__name__ for output in outputs]


def answers(rig: Rig) -> dict[int, list[Answer]]:
    """The final answers of every request."""
    found: dict[int, list[Answer]] = {number: [] for number in range(1, rig.requests + 1)}
    for answer in of(rig.outputs, Answer):
        if answer.final:
            found.setdefault(answer.request_id, []).append(answer)
    return found


def lockstep(**changes: Any) -> Rig:
    return Rig(lockstep=True, **changes)


def memory(**changes: Any) -> Memory:
    facts = CertificateFacts("c1", "controller", "model", "task", "profile", 1, 0.01, 0.015, 1500, 2500, 1)
    full = Memory(
        "r",
        MEMORY_SCHEMA,
        1,
        1,
        "model",
        GAP,
        0.01,
        (facts,),
        campaign_digest="campaign",
        watch_n=7,
        watch_exceedances=1,
        watch_e_value=3.0,
    )
    return msgspec.structs.replace(full, **changes)


def sources(outputs: list[Output]) -> list[str]:
    return [send.source for send in of(outputs, Send)]


def reason(rig: Rig) -> object:
    return core.status(rig.state)["reason"]


def reopen(rig: Rig) -> int:
    """Control instants until the controller's commands pass again."""
    for count in range(20):
        rig.observe()
        if sources(rig.propose()) == ["controller"]:
            return count
    raise AssertionError("the gate stays closed")
