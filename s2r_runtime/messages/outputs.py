"""Outputs: out of the core. Actions are what the daemon is to do; records say what was decided, and why."""

from __future__ import annotations

from typing import Literal

from s2r_runtime.messages.link import Scenarios, Source, Struct
from s2r_runtime.messages.memory import Memory, Stretch
from s2r_runtime.messages.results import CertificateFacts, Gap, RunLimits, Tries, Verification

# ---------------------------------------------------------------- actions


class Ask(Struct, frozen=True, tag="ask"):
    """The daemon is to ask this source what to do about this observation."""

    t_ns: int
    source: Source
    obs_seq: int


class Send(Struct, frozen=True, tag="send"):
    """The one command that goes to the robot. Everything that moves it is one of these."""

    t_ns: int
    seq: int
    source: Source
    u: tuple[float, ...]
    obs_seq: int
    ttl_ns: int


class StartCampaign(Struct, frozen=True, tag="start_campaign"):
    """The sampler is to take `n` samples for the gap of `epoch`, which has `beta`. resume: it goes on where an earlier one stopped.

    seed: of all that it draws.
    """

    t_ns: int
    epoch: int
    n: int
    beta: float
    seed: int
    resume: bool


class StartInputs(Struct, frozen=True, tag="start_inputs"):
    """The sampler is to drive the inputs of this digest, `n` rows, one a control instant. They are attached to the log."""

    t_ns: int
    digest: str
    n: int


class StopCampaign(Struct, frozen=True, tag="stop_campaign"):
    """The sampler is to stop: a campaign, or given inputs."""

    t_ns: int
    reason: str


class StartController(Struct, frozen=True, tag="start_controller"):
    """The controller of this digest is to start in its process: it was deployed, and this certificate covers it. scenarios: that it is to
    drive; None: those of the run's seed, as many as the profile says.
    """

    t_ns: int
    digest: str
    certificate_id: str
    scenarios: Scenarios | None = None


class StopController(Struct, frozen=True, tag="stop_controller"):
    """The controller's process is to end. reason: the gate's, a fault's, or the request's."""

    t_ns: int
    reason: str


class StartJob(Struct, frozen=True, tag="start_job"):
    """What the worker is to do.

    gap: of campaign `epoch` at `beta`. verify: controller `digest` at up to `radius`, `hold_radius`, at `least_radius` at least (0: at
    `radius`), attempt, seed, `beta`.
    trace: the residual of the model `digest` in the newest `rows` observations of `stretch` before this record; `epoch`: of the gap then
    in force (0: none).
    """

    t_ns: int
    job_id: int
    kind: Literal["gap", "verify", "trace"]
    epoch: int = 0
    digest: str = ""
    radius: float = 0.0
    hold_radius: float = 0.0
    attempt: int = 0
    seed: int = 0
    beta: float = 0.0
    stretch: Literal["", "campaign", "drive", "inputs"] = ""
    rows: int = 0
    least_radius: float = 0.0


class DrawSeed(Struct, frozen=True, tag="draw_seed"):
    """The attempt is paid for: the daemon is to draw its seed, once that is durable."""

    t_ns: int
    job_id: int
    attempt: int


class IssueCertificate(Struct, frozen=True, tag="issue_certificate"):
    """Sign what was shown: the gap in force and this verification. tries: None in a log of before (rules < 5). run_limits: of this
    controller, under any certificate; None: it drove no run, or a log of before (rules < 11).
    """

    t_ns: int
    gap: Gap
    verification: Verification
    request_id: int
    lifetime_s: int
    tries: Tries | None = None
    run_limits: RunLimits | None = None


class Persist(Struct, frozen=True, tag="persist"):
    """Write the memory durably before the outputs after this one take effect. later: nothing waits for it (rules 11)."""

    t_ns: int
    memory: Memory
    later: bool = False


class Answer(Struct, frozen=True, tag="answer"):
    """Reply to an operator's request; `final` false for progress on the way. exit_code as on the command line."""

    t_ns: int
    request_id: int
    exit_code: int
    text: str
    final: bool = True


# ---------------------------------------------------------------- records


class Decided(Struct, frozen=True, tag="decided"):
    """The gate's verdict on one proposed command. `margin`: how far inside (>= 0) or outside (< 0) the failing bound, in its unit."""

    t_ns: int
    source: Source
    seq: int
    obs_seq: int
    allow: bool
    reason: str
    margin: float


class GateChanged(Struct, frozen=True, tag="gate_changed"):
    """The gate opened, closed, or is closed for another reason than before. reason: `allowed`, or one of `gate.REASONS`."""

    t_ns: int
    open: bool
    reason: str
    detail: str = ""


class EpochChanged(Struct, frozen=True, tag="epoch_changed"):
    """A campaign was begun (gap None: beta is spent now) or its gap is in force."""

    t_ns: int
    epoch: int
    beta: float
    gap: Gap | None = None


class AttemptSpent(Struct, frozen=True, tag="attempt_spent"):
    """Verification attempt `attempt` was begun; its beta is gone, passed or not."""

    t_ns: int
    attempt: int
    beta: float
    digest: str
    radius: float


class AttemptEnded(Struct, frozen=True, tag="attempt_ended"):
    """The verification that `AttemptSpent` began is over. reason: why it did not pass; a sentence also where it did."""

    t_ns: int
    attempt: int
    passed: bool
    reason: str


class RadiusGrew(Struct, frozen=True, tag="radius_grew"):
    """A discrepancy, of the transition that ended with `obs_seq`, was above the radius in force and is the new `radius` (guarantee G5).

    verified_radius: of the certificate that drives, 0 if none does; the gate closes if that is the smaller one. In the norm's unit.
    """

    t_ns: int
    radius: float
    verified_radius: float
    obs_seq: int


class AlarmRaised(Struct, frozen=True, tag="alarm_raised"):
    """The watch's e-value reached 1/alpha: every certificate of this epoch's gap is revoked."""

    t_ns: int
    e_value: float
    alpha: float
    epoch: int


class ChangeNoticed(Struct, frozen=True, tag="change_noticed"):
    """The robot is probably not what it was. change: the detector reached `bar`, the average number of discrepancies between two such
    notices where nothing changed. exchangeability: the discrepancies of this epoch's driving are not of one law. Neither revokes anything.
    """

    t_ns: int
    kind: Literal["change", "exchangeability"]
    value: float
    bar: float
    epoch: int
    obs_seq: int


class CertificateInstalled(Struct, frozen=True, tag="certificate_installed"):
    """A certificate is in force here. Those of the same controller that reach no farther are not any more."""

    t_ns: int
    facts: CertificateFacts


class Revoked(Struct, frozen=True, tag="revoked"):
    """A certificate ended for good: nothing that is loaded or restored brings it back."""

    t_ns: int
    certificate_id: str
    reason: str


class EpisodeCounted(Struct, frozen=True, tag="episode_counted"):
    """A run of a certified controller is over (guarantee G10). reason: why it counts as it does. left_out: the controller did not drive
    it from its start, and nothing went wrong in it; it is in no count.

    index, steps, safety: of the scenario, as last scored; safety None: not known. limits: of the controller's runs, and of those under this
    certificate, after this one.
    """

    t_ns: int
    controller: str
    certificate: str
    index: int
    steps: int
    safety: float | None
    outcome: Literal["safe", "unsafe", "censored", "left_out"]
    reason: str
    limits: tuple[RunLimits, ...]


class TraceEnded(Struct, frozen=True, tag="trace_ended"):
    """A trace is over: its verdict, or the reason why there is none. `proposal`: digest of the model that is proposed, or empty."""

    t_ns: int
    job_id: int
    stretch: Stretch
    epoch: int
    verdict: str
    reason: str = ""
    proposal: str = ""


class ModelAdopted(Struct, frozen=True, tag="model_adopted"):
    """This model is in force, without a gap until a fresh campaign. `by`: the user who decided it; -1: the profile (`repair.adopt`).

    `proposed`: it is the model that tracing proposed.
    """

    t_ns: int
    digest: str
    by: int
    proposed: bool = False


Action = (
    Ask | Send | StartCampaign | StartInputs | StopCampaign | StartController | StopController | StartJob | IssueCertificate | Persist
    | Answer | DrawSeed
)  # fmt: skip
Record = (
    Decided | GateChanged | EpochChanged | AttemptSpent | AttemptEnded | RadiusGrew | AlarmRaised | ChangeNoticed | CertificateInstalled
    | Revoked | TraceEnded | ModelAdopted | EpisodeCounted
)  # fmt: skip
Output = Action | Record
