"""Events: into the core, in the order in which they are logged."""

from __future__ import annotations

from typing import Literal

from s2r_runtime.messages.link import Command, Observation, Scenarios, Source, Struct
from s2r_runtime.messages.memory import Memory, Settings
from s2r_runtime.messages.results import CertificateFacts, Gap, Verification


class Started(Struct, frozen=True, tag="started"):
    """First event of every run; a restored memory is that of the same robot and schema, or there is none."""

    t_ns: int
    unix_s: int
    settings: Settings
    memory: Memory


class Observed(Struct, frozen=True, tag="observed"):
    """The robot was heard. `t_ns`: when the frame arrived (the host's clock); in lockstep the robot's own stamp."""

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
    """The time of day, for expiry alone: read about once a second. unix_s: s since 1970, UTC."""

    t_ns: int
    unix_s: int


class LinkChanged(Struct, frozen=True, tag="link_changed"):
    """A transport found its robot (`up`), or lost it, with the reason in `detail`. A robot that started anew: down, then up."""

    t_ns: int
    up: bool
    detail: str = ""


class RecorderChanged(Struct, frozen=True, tag="recorder_changed"):
    """The recorder failed (disk full, thread dead) or works again.

    late: nothing is lost, but more of the log waits for the disk than may be lost in a crash. A campaign waits until it is written.
    """

    t_ns: int
    ok: bool
    detail: str = ""
    late: bool = False


class AnalyticsChanged(Struct, frozen=True, tag="analytics_changed"):
    """The process that measures while a controller drives died (or hung), or is there again. Unwatched, nobody drives: the gate
    closes with the reason `analytics_down`. Up after start unless this says otherwise. late: it did not die; it fell behind the robot by
    more than the profile allows, or caught up, and measures on where it was.
    """

    t_ns: int
    up: bool
    detail: str = ""
    late: bool = False


class Stopping(Struct, frozen=True, tag="stopping"):
    """Last event of an orderly run: sources are stopped, the recovery command goes out, the memory is persisted."""

    t_ns: int
    detail: str = ""


class OverrideChanged(Struct, frozen=True, tag="override_changed"):
    """A transport's emergency stop or manual override signal, or two robots under one name (each latches until cleared)."""

    t_ns: int
    kind: Literal["emergency_stop", "manual_override", "robot_twin"]
    detail: str = ""


class ObservationRefused(Struct, frozen=True, tag="observation_refused"):
    """A transport dropped something that came in the robot's name, although the robot is well: an echo, a late or a foreign message.

    The gate stays as it is; the core counts these, together with faulty observations (`gate.fault_share`). detail: what was wrong.
    """

    t_ns: int
    detail: str


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
    """A source is gone. `reason`: finished, raised, died, deadline, malformed, inconsistent, stopped, start_failed.

    inconsistent: a controller that answered the same question otherwise when it was asked again; its certificates are revoked.
    """

    t_ns: int
    source: Source
    reason: Literal["finished", "raised", "died", "deadline", "malformed", "inconsistent", "stopped", "start_failed"]
    detail: str = ""


class AnswerLate(Struct, frozen=True, tag="answer_late"):
    """The controller's answer is not there at its deadline, for a reason of the computer's: the daemon stood still, or the controller's
    process waits for a processor. The question is void; the controller is not at fault.
    """

    t_ns: int
    obs_seq: int
    detail: str = ""


class SampleTaken(Struct, frozen=True, tag="sample_taken"):
    """One independent transition of a campaign (guarantee G1). x0, x1: (nx,), one period apart; u: (nu,), held before x0 (or from x0 on)
    until after x1.

    `held`: (nx,), the state after `periods` held periods, or empty if the campaign holds for one period only. `obs_seq0`,
    `t0_ns`: of the observation that x0 was; the robot's numbers, so that an auditor finds the raw frame. `again`: logged once more
    when an interrupted campaign goes on in a new log, so that the log holds all of them; its frames are in the earlier one.

    Under `Settings.rules` 1 also: `lasts_ns`: from x0's stamp to x1's. `period`: which period of the hold x0 begins. `start`, `start_seq`,
    `start_ns`: state, number and stamp of the observation at which the hold began; `hold_ns`: from there to `held`. `past_u`, `past_ns`:
    the commands before the hold, oldest first, and how long each lasted.
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
    """(nx,), observed one period before the hold, while the robot stood still: it differs from the hold's first state by noise alone."""
    again: bool = False
    lasts_ns: int = 0
    period: int = 0
    start: tuple[float, ...] = ()
    start_seq: int = 0
    start_ns: int = 0
    hold_ns: int = 0
    past_u: tuple[tuple[float, ...], ...] = ()
    past_ns: tuple[int, ...] = ()


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
    behaviour: str = ""
    """verify: digest of the controller's answers on the probe set (`probe`); empty: it gave none."""


class SeedDrawn(Struct, frozen=True, tag="seed_drawn"):
    """The seed of a verification attempt, 0 .. 2^48 - 1: drawn from the operating system's entropy after the attempt was paid for.

    fixed: a simulation fixed it beforehand, so that it can be repeated; every certificate that rests on it says so.
    """

    t_ns: int
    job_id: int
    attempt: int
    seed: int
    fixed: bool = False


class EpisodeEnded(Struct, frozen=True, tag="episode_ended"):
    """The driving controller finished a scenario of its task (the core counts it). safety, progress: as the task measures them."""

    t_ns: int
    index: int
    steps: int
    safety: float
    progress: float
    detail: str = ""


class EpisodeScored(Struct, frozen=True, tag="episode_scored"):
    """The safety value of the scenario in progress fell below the profile's threshold (`below`), or is no longer below it.

    safety: after `steps` observations; where detail names a lack, it has no finite value, and counts as below.
    """

    t_ns: int
    index: int
    steps: int
    safety: float
    below: bool
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

    deploy: `digest` of the controller that was loaded for it; `scenarios` that it is to drive (None: as the profile says).
    adopt: `digest` of the model. revoke: `text` a certificate
    id, or empty for all. clear: `text` the reason. permit: `duration_s`. sample: `count` (0: the profile's), `text` "retry" to
    repeat it once if its samples depend on each other. excite: `digest` of the
    inputs, `count` their rows. trace: `text` a stretch (empty: campaign). pause: `count` the request whose asker is gone (0: none,
    a person pauses whatever the sampler drives), `text` why.
    """

    t_ns: int
    request_id: int
    verb: Literal[
        "deploy", "undeploy", "revoke", "adopt", "clear", "stop", "permit", "sample", "cancel", "trace", "verify", "excite", "pause"
    ]
    by: int
    digest: str = ""
    text: str = ""
    duration_s: float = 0.0
    count: int = 0
    scenarios: Scenarios | None = None


Event = (
    Started | Observed | Proposed | Ticked | WallClockRead | LinkChanged | RecorderChanged | AnalyticsChanged | OverrideChanged | Measured
    | EpisodeEnded | SourceStarted | SourceStopped | SampleTaken | CampaignFinished | InputsFinished | JobFinished | CertificateStored
    | CertificateFailed | CertificatesDistrusted | Requested | Stopping | ObservationRefused | AnswerLate | SeedDrawn | EpisodeScored
)  # fmt: skip
