"""What flows through the runtime: frozen structs with stamps and units. SI and radians throughout.

Three families. *Frames* are what a transport received or sent, byte for byte. *Events* go into the core in the order in
which they are logged. *Outputs* come out of it: records (what was decided, and why) and actions (what the daemon is to
do). `t_ns` is an integer on the daemon's monotonic clock: the host's in real time, the robot's own in lockstep.

No field holds NaN or inf. What arrives non-finite is turned, at the edge, into a value with `fault` set and no numbers.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Source = Literal["controller", "sampler", "recovery", "external"]
Stretch = Literal["campaign", "drive", "inputs"]
"""What a trace is made on: the newest campaign; what controllers drove since its gap came into force; the newest drive of given inputs."""


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all that is logged; `tag` is the channel's last word."""


# ---------------------------------------------------------------- frames, observations, commands


class Frame(Struct, frozen=True, tag="frame"):
    """Bytes as a transport received (`inbound`) or sent them. `arrival_ns`: host monotonic clock."""

    arrival_ns: int
    channel: str
    data: bytes
    inbound: bool = True


class Observation(Struct, frozen=True, tag="observation"):
    """Measured model state. x: (nx,) in the model's order; `stamp_ns`: the robot's own monotonic clock.

    `fault` is not empty iff the observation cannot be used (then x may be empty): what was wrong with it, in a few words.
    """

    seq: int
    stamp_ns: int
    x: tuple[float, ...]
    fault: str = ""


class Command(Struct, frozen=True, tag="command"):
    """An input that somebody asks the robot to apply. u: (nu,); answers the observation `obs_seq`; void after `ttl_ns`."""

    seq: int
    t_ns: int
    source: Source
    u: tuple[float, ...]
    obs_seq: int
    ttl_ns: int
    fault: str = ""


# ---------------------------------------------------------------- results that events carry

SERIAL = "the error of a sample depends on the one before"
"""`Gap.white_reason` begins with this where the samples were not independent: such a campaign founds no gap (guarantee G1)."""


class Gap(Struct, frozen=True, tag="gap"):
    """Gap of a model on one campaign (guarantee G1). `radius` in the weighted norm's unit; weights: (nx,).

    `hold_radius`: the same bound for the discrepancy after `hold_periods` held periods. `radius_noise`: what measurement
    noise alone would make of `radius`.
    """

    radius: float
    radius_literal: float
    hold_radius: float
    hold_periods: int
    set: Literal["ball", "box"]
    weights: tuple[float, ...]
    n: int
    discarded: int
    epsilon: float
    beta: float
    epoch: int
    model_digest: str
    transitions_digest: str
    rejected: dict[str, int] = {}
    radius_noise: float | None = None
    white: bool = True
    white_reason: str = ""
    """What structure the residual has, where it isn't white."""


class LawResult(Struct, frozen=True):
    """One disturbance law's rollouts. `failure_upper`: Clopper-Pearson bound on P(s < threshold) at `beta`."""

    law: str
    n: int
    s_star: float
    failures: int
    failure_upper: float
    progress: float
    progress_ok: bool
    required: bool
    passed: bool


class RadiusTried(Struct, frozen=True):
    """One of the radii that were fixed beforehand, ascending by `index`, and what came of it. s_star: the least under any required law
    that was run there; they end at the first that fails.
    """

    index: int
    radius: float
    passed: bool
    s_star: float


class Verification(Struct, frozen=True, tag="verification"):
    """Rollouts of the uncertain model and what they show (guarantee G2, G8). radius: the largest at which it passed, of `split` radii fixed
    beforehand, each with 1 / `split` of `beta` (`headroom`); `tried`: those that were looked at, in that order.
    """

    passed: bool
    radius: float
    hold_radius: float
    threshold: float
    epsilon: float
    beta: float
    attempt: int
    seed: int
    laws: tuple[LawResult, ...]
    controller_digest: str
    model_digest: str
    task_digest: str
    reason: str = ""
    split: int = 1
    tried: tuple[RadiusTried, ...] = ()


class Trials(Struct, frozen=True):
    """Closed-loop runs of a controller on the robot, from its logs (guarantee G9, `trials`). worst: least safety value.

    unsafe_upper: Clopper-Pearson bound on the probability of an unsafe run; radius: the largest discrepancy in any of the runs, which a
    new run exceeds with probability at most epsilon; each at `beta`. fixed: n was fixed beforehand. left_out: why -> runs.
    logs: heads of the chains of the logs that they were taken from.
    """

    n: int
    unsafe: int
    unsafe_upper: float
    worst: float
    radius: float
    epsilon: float
    beta: float
    fixed: bool
    left_out: dict[str, int]
    logs: tuple[str, ...]
    controller_digest: str
    task_digest: str
    model_digest: str


class CertificateFacts(Struct, frozen=True):
    """What the gate compares. Taken from a certificate whose signature was verified when it was loaded."""

    id: str
    controller_digest: str
    model_digest: str
    task_digest: str
    profile_digest: str
    epoch: int
    radius: float
    verified_radius: float
    issued_unix_s: int
    expires_unix_s: int
    attempt: int = 0
    """Verification attempt that it rests on, so that a loaded certificate counts as spent."""


# ---------------------------------------------------------------- the core's settings and memory


class Settings(Struct, frozen=True):
    """What the profile fixes for the core. Bounds: (lower, upper) a state or input; angles are wrapped and unbounded."""

    robot: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    dt_ns: int
    lockstep: bool
    region: tuple[tuple[float, float], ...]
    geofence: tuple[tuple[float, float], ...]
    input_bounds: tuple[tuple[float, float], ...]
    observation_timeout_ns: int
    command_ttl_ns: int
    hysteresis_ns: int
    settle_periods: int
    latching: tuple[str, ...]
    recovery: Literal["stop", "hold", "return"]
    recovery_input: tuple[float, ...]
    home: tuple[float, ...]
    model_name: str
    model_digest: str
    task_digest: str
    profile_digest: str
    epsilon: float
    beta: float
    discard: int
    campaign_n: int
    headroom: float
    alpha: float
    max_measurement_faults: int
    certificate_lifetime_s: int
    seed: int
    campaign_timeout_s: float = 0.0
    trace_after_campaign: bool = False
    trace_after_inputs: bool = False
    trace_on_growth: bool = False
    trace_delay_ns: int = 10_000_000_000
    """How long is driven on, after the gap grew, before that is traced."""
    trace_rows: int = 40_000
    """Observations that a trace is made on at most, the newest."""
    adopt: Literal["ask", "always"] = "ask"
    """Whose decision it is to use a proposed model: a person's, or the profile's."""
    required_laws: tuple[str, ...] = ()
    """Disturbance laws that must pass (guarantee G8); empty: not said, the verification's own word counts."""
    campaign_digest: str = ""
    """Of what a gap rests on besides the model: region, inputs, norm, sampling, guarantee. Another one voids the gap."""
    run_length: float = 1e5
    """Discrepancies between two false notices of change, at least, on average (guarantee G5)."""
    norm_set: Literal["", "ball", "box"] = ""
    norm_weights: tuple[float, ...] = ()
    """The norm that every gap here is measured in: its set, and a weight for each state; empty: not said."""


MEMORY_SCHEMA = 1
"""Of `Memory`: a memory of another schema is refused."""


class WatchStood(Struct, frozen=True):
    """Where the watch of an epoch stands: what goes on after a restart. counts: of discrepancies by bin (`core.stream`)."""

    n: int = 0
    exceedances: int = 0
    e_value: float = 1.0
    change: float = 0.0
    exchange: float = 1.0
    counts: tuple[int, ...] = ()


class Proposal(Struct, frozen=True):
    """A repaired model that tracing proposes. `digest`: its; `base`: of the model in whose residual the effects were found.

    `stretch`, `epoch`: what it was traced on; `effects`: in words.
    """

    digest: str
    base: str
    stretch: Stretch
    epoch: int
    effects: tuple[str, ...] = ()


class Memory(Struct, frozen=True):
    """What outlives a restart: counters, the gap in force, the grown radius, certificates and revocations."""

    robot: str
    schema: int
    epochs: int = 0
    attempts: int = 0
    model_digest: str = ""
    gap: Gap | None = None
    radius: float = 0.0
    certificates: tuple[CertificateFacts, ...] = ()
    revoked: dict[str, str] = {}
    latched: tuple[str, ...] = ()
    campaign_epoch: int = 0
    """Epoch of a campaign that was begun and not finished (0: none); resuming it costs no new epoch."""
    campaign_n: int = 0
    """How many samples that campaign fixed beforehand."""
    campaign_digest: str = ""
    """`Settings.campaign_digest` when the gap in force was measured."""
    alarm_epoch: int = 0
    """Epoch whose gap the watch refuted (0: none): it founds no certificate any more, only a fresh campaign does."""
    watch_n: int = 0
    watch_exceedances: int = 0
    watch_e_value: float = 1.0
    """Where the watch of this epoch stood when the memory was last written, so that a restart forgives nothing."""
    watch_change: float = 0.0
    watch_exchange: float = 1.0
    watch_counts: tuple[int, ...] = ()
    """Its other tests, and how many discrepancies fell into each bin (`core.stream`)."""
    traced: bool = False
    """An effect was traced in the residual and no model that has it was adopted since (guarantee G8)."""
    proposal: Proposal | None = None
    """The newest repaired model that waits to be adopted."""
    refuted: tuple[str, ...] = ()
    """Digests of the transitions whose gaps ended refuted or outgrown: they found no later epoch."""


# ---------------------------------------------------------------- events: into the core


class Started(Struct, frozen=True, tag="started"):
    """First event of every run; a restored memory is that of the same robot and schema, or there is none."""

    t_ns: int
    unix_s: int
    settings: Settings
    memory: Memory


class Observed(Struct, frozen=True, tag="observed"):
    t_ns: int
    observation: Observation


class Proposed(Struct, frozen=True, tag="proposed"):
    """A source answers an `Ask` (or an outsider commands unasked: source `external`, which is never allowed)."""

    t_ns: int
    command: Command


class Ticked(Struct, frozen=True, tag="ticked"):
    """Time passed. At least every 20 ms in real time, also when nothing else happens."""

    t_ns: int


class WallClockRead(Struct, frozen=True, tag="wall_clock_read"):
    t_ns: int
    unix_s: int


class LinkChanged(Struct, frozen=True, tag="link_changed"):
    t_ns: int
    up: bool
    detail: str = ""


class RecorderChanged(Struct, frozen=True, tag="recorder_changed"):
    """The recorder failed (disk full, thread dead) or works again."""

    t_ns: int
    ok: bool
    detail: str = ""


class AnalyticsChanged(Struct, frozen=True, tag="analytics_changed"):
    """The process that measures while a controller drives died (or hung), or is there again. Unwatched, nobody drives: the gate
    closes with the reason `analytics_down`. Up after start unless this says otherwise.
    """

    t_ns: int
    up: bool
    detail: str = ""


class Stopping(Struct, frozen=True, tag="stopping"):
    """Last event of an orderly run: sources are stopped, the recovery command goes out, the memory is persisted."""

    t_ns: int
    detail: str = ""


class OverrideChanged(Struct, frozen=True, tag="override_changed"):
    """A transport's emergency stop or manual override signal (latches until cleared)."""

    t_ns: int
    kind: Literal["emergency_stop", "manual_override"]
    detail: str = ""


class Measured(Struct, frozen=True, tag="measured"):
    """One discrepancy of the stream, from analytics: of the transition that ended with observation `obs_seq`.

    `fault`: the measurement-fault rule that rejected it (then it does not count), or empty. `e_value`: the watch's, after it; `change`: of
    its detector of changes; `exchange`: its evidence that the discrepancies are not exchangeable.
    """

    t_ns: int
    obs_seq: int
    discrepancy: float
    fault: str
    e_value: float
    n: int
    exceedances: int
    epoch: int = 0
    """Of the gap it was measured against; one of another epoch than that in force is ignored (0: not said)."""
    change: float = 0.0
    exchange: float = 1.0


class SourceStarted(Struct, frozen=True, tag="source_started"):
    """A source runs and can be asked. `digest`: of what really runs (controller), or of the campaign's settings."""

    t_ns: int
    source: Source
    digest: str


class SourceStopped(Struct, frozen=True, tag="source_stopped"):
    """A source is gone. `reason`: finished, raised, died, deadline, malformed, stopped, start_failed."""

    t_ns: int
    source: Source
    reason: Literal["finished", "raised", "died", "deadline", "malformed", "stopped", "start_failed"]
    detail: str = ""


class SampleTaken(Struct, frozen=True, tag="sample_taken"):
    """One independent transition of a campaign (guarantee G1). x0, x1: (nx,), one period apart; u: (nu,), held from x0 on.

    `held`: (nx,), the state after `periods` held periods, or empty if the campaign holds for one period only. `obs_seq0`,
    `t0_ns`: of the observation that x0 was; the robot's numbers, so that an auditor finds the raw frame. `again`: logged once more
    when an interrupted campaign goes on in a new log, so that the log holds all of them; its frames are in the earlier one.
    """

    t_ns: int
    epoch: int
    index: int
    obs_seq0: int
    t0_ns: int
    u: tuple[float, ...]
    x0: tuple[float, ...]
    x1: tuple[float, ...]
    held: tuple[float, ...]
    periods: int
    before: tuple[float, ...] = ()
    """(nx,), observed one period before x0, while the robot stood still: the two differ by measurement noise alone."""
    again: bool = False


class CampaignFinished(Struct, frozen=True, tag="campaign_finished"):
    """`complete` iff all samples that were fixed beforehand are there. Stopping early costs the epoch but founds no gap."""

    t_ns: int
    epoch: int
    n: int
    complete: bool
    rejected: dict[str, int]
    detail: str = ""


class InputsFinished(Struct, frozen=True, tag="inputs_finished"):
    """Given inputs were driven, `n` rows of them; `complete` iff that is all. They were chosen, so they found no gap."""

    t_ns: int
    digest: str
    n: int
    complete: bool
    detail: str = ""


class JobFinished(Struct, frozen=True, tag="job_finished"):
    """A worker's result: exactly one of gap, verification, trace is there unless `error` is not empty. trace: docs/log-format.md."""

    t_ns: int
    job_id: int
    kind: Literal["gap", "verify", "trace"]
    gap: Gap | None = None
    verification: Verification | None = None
    trace: dict[str, object] | None = None
    error: str = ""
    safety: dict[str, list[float]] = {}
    """verify: the safety value of every scenario, by law (for the report; the audit recomputes them)."""


class EpisodeEnded(Struct, frozen=True, tag="episode_ended"):
    """The driving controller finished a scenario of its task (the core counts it). safety, progress: as the task measures them."""

    t_ns: int
    index: int
    steps: int
    safety: float
    progress: float
    detail: str = ""


class CertificateStored(Struct, frozen=True, tag="certificate_stored"):
    """A certificate was signed or loaded, its signature verified against a trusted key, and it is durable in the log.

    `gap`: the gap it rests on, present when it was loaded from a file rather than issued by this daemon.
    """

    t_ns: int
    facts: CertificateFacts
    gap: Gap | None = None
    request_id: int = 0


class CertificateFailed(Struct, frozen=True, tag="certificate_failed"):
    """An `IssueCertificate` came to nothing (no key, or it could not be made durable), or a loaded certificate was refused."""

    t_ns: int
    error: str
    request_id: int = 0


class CertificatesDistrusted(Struct, frozen=True, tag="certificates_distrusted"):
    """Certificates (by id) that are not believed any more: their key was revoked or is not trusted now, or their file was changed."""

    t_ns: int
    reasons: dict[str, str]


class Requested(Struct, frozen=True, tag="requested"):
    """An operator's decision, from the control socket. `by`: user id of the peer. Unused fields are at their defaults.

    deploy: `digest` of the controller that was loaded for it. adopt: `digest` of the model. revoke: `text` a certificate
    id, or empty for all. clear: `text` the reason. permit: `duration_s`. sample: `count` (0: the profile's). excite: `digest` of the
    inputs, `count` their rows. trace: `text` a stretch (empty: campaign).
    """

    t_ns: int
    request_id: int
    verb: Literal["deploy", "undeploy", "revoke", "adopt", "clear", "stop", "permit", "sample", "cancel", "trace", "verify", "excite"]
    by: int
    digest: str = ""
    text: str = ""
    duration_s: float = 0.0
    count: int = 0


Event = (
    Started | Observed | Proposed | Ticked | WallClockRead | LinkChanged | RecorderChanged | AnalyticsChanged | OverrideChanged | Measured
    | EpisodeEnded | SourceStarted | SourceStopped | SampleTaken | CampaignFinished | InputsFinished | JobFinished | CertificateStored
    | CertificateFailed | CertificatesDistrusted | Requested | Stopping
)  # fmt: skip


# ---------------------------------------------------------------- outputs: actions


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
    t_ns: int
    digest: str
    certificate_id: str


class StopController(Struct, frozen=True, tag="stop_controller"):
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


class IssueCertificate(Struct, frozen=True, tag="issue_certificate"):
    """Sign what was shown: the gap in force and this verification."""

    t_ns: int
    gap: Gap
    verification: Verification
    request_id: int
    lifetime_s: int


class Persist(Struct, frozen=True, tag="persist"):
    """Write the memory durably before the outputs after this one take effect."""

    t_ns: int
    memory: Memory


class Answer(Struct, frozen=True, tag="answer"):
    """Reply to an operator's request; `final` false for progress on the way. exit_code as on the command line."""

    t_ns: int
    request_id: int
    exit_code: int
    text: str
    final: bool = True


class LogHead(Struct, frozen=True, tag="log_head"):
    """Not logged, but told to whoever keeps it: so far the log of this run is on the disk (docs/log-format.md). head, public_key: hex."""

    run: str
    part: int
    records: int
    head: str
    public_key: str


# ---------------------------------------------------------------- outputs: records


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
    t_ns: int
    attempt: int
    passed: bool
    reason: str


class RadiusGrew(Struct, frozen=True, tag="radius_grew"):
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
    t_ns: int
    facts: CertificateFacts


class Revoked(Struct, frozen=True, tag="revoked"):
    t_ns: int
    certificate_id: str
    reason: str


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
    | Answer
)  # fmt: skip
Record = (
    Decided | GateChanged | EpochChanged | AttemptSpent | AttemptEnded | RadiusGrew | AlarmRaised | ChangeNoticed | CertificateInstalled
    | Revoked | TraceEnded | ModelAdopted
)  # fmt: skip
Output = Action | Record
