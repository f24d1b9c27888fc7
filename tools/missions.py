"""One robot's life through the core's public door, without a robot: `handle(state, event)`, and a worker and signer that answer at once.

A controller is the probability with which a rollout of the uncertain model fails; verification draws as many scenarios as its share asks
for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.core import reducer as core
from s2r_runtime.core.headroom import grid, search
from s2r_runtime.core.state import State, certificate, usable_gap
from s2r_runtime.daemon.settings import facts_of, settings_of
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_upper, sample_size
from s2r_runtime.evidence.gap import estimate_gap
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
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
    Settings,
    SourceStarted,
    StartCampaign,
    StartController,
    Started,
    StartJob,
    Verification,
)
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile, parse_profile
from s2r_runtime.recordings.transitions import Transitions

Array = NDArray[np.float64]

SECOND = 1_000_000_000
PROFILE = """
[robot]
name = "mission"
[model]
name = "unicycle"
dt = 0.033
[region]
x = [-10.0, 10.0]
y = [-10.0, 10.0]
[inputs]
v = [-1.0, 1.0]
w = [-3.0, 3.0]
[guarantee]
epsilon = 0.03
beta = 0.05
alpha = 0.01
[verification]
epsilon = 0.03
[task]
name = "keep_out"
[transport]
name = "none"
"""


def profile_and_settings() -> tuple[Profile, ComposedModel, Settings]:
    """Of the robot of all missions."""
    profile = parse_profile(PROFILE, "mission.toml", Path())
    model = compose(ModelSpec("unicycle", profile.model.dt))
    return profile, model, settings_of(profile, profile.model, facts_of(model))


@dataclass
class Life:
    """One mission. state: the core's. gaps: all that came into force. refused: campaigns that founded no gap."""

    settings: Settings
    model: ComposedModel
    rng: np.random.Generator
    failure: dict[str, float]
    """By controller: probability that a rollout fails."""

    def __post_init__(self) -> None:
        self.state: State = core.initial()
        self.t, self.requests, self.refused = SECOND, 0, 0
        self.gaps: list[Gap] = []
        self.installed: list[CertificateFacts] = []
        self.feed(Started(self.t, 1500, self.settings, Memory(self.settings.robot, MEMORY_SCHEMA)))
        self.feed(LinkChanged(self.t, up=True))
        self.feed(Observed(self.t, Observation(1, self.t, (0.0, 0.0, 0.0))))

    def feed(self, event: Event) -> tuple[Output, ...]:
        """One event, and what the daemon owes the core for its outputs."""
        self.state, outputs = core.handle(self.state, event)
        for output in outputs:
            if isinstance(output, DrawSeed):
                self.feed(SeedDrawn(self.t, output.job_id, output.attempt, int(self.rng.integers(1 << 48))))
            elif isinstance(output, StartJob) and output.kind == "verify":
                self.feed(self._verified(output))
            elif isinstance(output, IssueCertificate):
                self.feed(self._stored(output))
            elif isinstance(output, StartController):
                self.feed(SourceStarted(self.t, "controller", output.digest))
        return outputs

    def ask(self, verb: str, **fields: object) -> tuple[Output, ...]:
        """What a person asks for."""
        self.requests += 1
        return self.feed(Requested(self.t, self.requests, verb, 1, **fields))  # type: ignore[arg-type]

    @property
    def certified(self) -> bool:
        """Whether a certificate is in force now under which a controller is deployed."""
        return certificate(self.state) is not None

    @property
    def gap(self) -> Gap | None:
        """The gap in force, unless the watch refuted it."""
        return usable_gap(self.state)

    def begin_campaign(self) -> int:
        """How many samples it asks for."""
        self.ask("undeploy")
        self.ask("clear", text="watch_alarm")
        self.ask("permit", duration_s=3600.0)
        order = next(output for output in self.ask("sample") if isinstance(output, StartCampaign))
        self.feed(SourceStarted(self.t, "sampler", ""))
        return order.n

    def end_campaign(self, e: Array) -> bool:
        """e: (n,) residuals in x, in order. Whether its gap came into force."""
        n, campaign = len(e), self.state.campaign
        assert campaign is not None
        outputs = self.feed(CampaignFinished(self.t, campaign.epoch, n, complete=True, rejected={}))
        job = next(output for output in outputs if isinstance(output, StartJob))
        rows = np.zeros((n, 3)), np.zeros((n, 2)), np.column_stack([e, np.zeros((n, 2))])
        tr = Transitions(rows[0], rows[1], rows[2], None, 1, True, {}, f"campaign {job.epoch}", np.arange(float(n)), "campaign")
        guarantee = {"epsilon": self.settings.epsilon, "beta": job.beta, "discard": self.settings.discard}
        try:
            gap = estimate_gap(self.model, tr, weights=(1.0, 1.0, 1.0), epoch=job.epoch, **guarantee)
            self.feed(JobFinished(self.t, job.job_id, "gap", gap=msgspec.structs.replace(gap, model_digest=self.settings.model_digest)))
        except NotEnoughEvidence as error:
            self.feed(JobFinished(self.t, job.job_id, "gap", error=str(error)))
        if self.gap is None:
            self.refused += 1
            return False
        self.gaps.append(self.gap)
        return True

    def deploy(self, controller: str) -> bool:
        """Tries it; whether it drives."""
        self.ask("deploy", digest=controller)
        return self.certified

    def see(self) -> None:
        """One control instant: the robot is seen, whoever is asked answers with zero."""
        self.t += self.settings.dt_ns
        seq = (self.state.seen_seq or 0) + 1
        self.feed(Observed(self.t, Observation(seq, self.t, (0.0, 0.0, 0.0))))
        asked = self.state.asked
        if asked is not None:
            self.feed(Proposed(self.t, Command(seq, self.t, asked.source, (0.0, 0.0), asked.obs_seq, self.settings.command_ttl_ns)))

    def measured(self, discrepancy: float, e_value: float, n: int, exceedances: int) -> None:
        """One discrepancy of the stream that changes something."""
        epoch = self.state.memory.gap.epoch if self.state.memory.gap is not None else 0
        self.feed(Measured(self.t, 1, discrepancy, "", e_value, n, exceedances, epoch))

    def false_certificates(self, violation: object) -> int:
        """Certificates that were installed although what they say is not so. violation: r -> V(r) under the law at that campaign."""
        assert callable(violation)
        wrong_gaps = {gap.epoch for gap in self.gaps if violation(gap.radius, gap.epoch) > gap.epsilon}
        bad = self.settings.epsilon
        return sum(facts.epoch in wrong_gaps or self.failure[facts.controller_digest] > bad for facts in self.installed)

    def _verified(self, job: StartJob) -> JobFinished:
        """As the worker searches: among radii that share beta, each here with scenarios of its own, which fail no less at lesser radii."""
        radii = grid(job.least_radius, job.radius)
        share = job.beta / len(radii)
        n = sample_size(self.settings.epsilon, share)
        drawn: dict[int, int] = {}

        def passes(index: int) -> bool:
            drawn[index] = int(self.rng.binomial(n, self.failure[job.digest]))
            return drawn[index] == 0

        best = search(len(radii), passes) or 0
        failures, part = drawn[best], radii[best] / job.radius if job.radius > 0.0 else 1.0
        passed, s_star = failures == 0, 1.0 if failures == 0 else -1.0
        upper = clopper_pearson_upper(failures, n, share)
        laws = tuple(LawResult(law, n, s_star, failures, upper, 1.0, True, True, passed) for law in self.settings.required_laws)
        numbers = (radii[best], job.hold_radius * part, 0.0, self.settings.epsilon, job.beta, job.attempt, job.seed)
        digests = (job.digest, self.settings.model_digest, self.settings.task_digest)
        return JobFinished(self.t, job.job_id, "verify", verification=Verification(passed, *numbers, laws, *digests, split=len(radii)))

    def _stored(self, order: IssueCertificate) -> CertificateStored:
        v, gap = order.verification, order.gap
        digests = (v.controller_digest, v.model_digest, v.task_digest, self.settings.profile_digest)
        facts = CertificateFacts(f"c{v.attempt}", *digests, gap.epoch, gap.radius, v.radius, 1500, 10**9, v.attempt)
        self.installed.append(facts)
        return CertificateStored(self.t, facts, request_id=order.request_id)
