"""What was measured and shown: gaps, verifications, runs on the robot, and what the gate knows of a certificate."""

from __future__ import annotations

from typing import Literal

from s2r_runtime.messages.link import Struct

SERIAL = "the error of a sample depends on the one before"
"""`Gap.white_reason` begins with this where the samples were not independent: such a campaign founds no gap (guarantee G1)."""
REPEATED = "the samples repeat each other"
"""`Gap.white_reason` begins with this where chance does not make rows so alike: copies, and rows made from rows."""
NOT_INDEPENDENT = (SERIAL, REPEATED)


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


class Tries(Struct, frozen=True):
    """How much was tried before a certificate was issued (guarantee G4).

    attempts: on any gap, all of which share one budget. on_gap: of these, on this gap. controllers: different ones among
    those, by their behaviour on the probe set. fixed: a simulation fixed the seed of this attempt.
    """

    attempts: int
    on_gap: int
    controllers: int
    fixed: bool = False


class RealMean(Struct, frozen=True):
    """Mean score of the real runs (guarantee G11, `real_means`). Limits at confidence 1-beta, valid at all times: `lower`, `upper` if the
    mean is one number for all runs; `running_*` of the mean over these runs without that assumption; `alone_*` without simulation.

    correlation: of real and simulated scores (0 where one does not vary). slope: that of the next run. runs_alone: number of runs
    without simulation for the same width, estimated from the widths; runs_saved: that less n.
    """

    n: int
    mean: float
    lower: float
    upper: float
    running_lower: float
    running_upper: float
    alone_lower: float
    alone_upper: float
    correlation: float
    slope: float
    runs_alone: float
    runs_saved: float
    beta: float


class Optimism(Struct, frozen=True):
    """By how much the simulator scores better than the robot (guarantee G12). mean: of the pairs; lower, upper: one-sided limits, each at
    confidence 1-beta and valid at all times.
    """

    n: int
    mean: float
    lower: float
    upper: float
    beta: float


class Simulated(Struct, frozen=True):
    """Real runs with simulated ones in the same scenarios. Values in the unit of `score`, whose range is low to high. rollouts: of the
    uncertain model in each run's scenario, and the same number in fresh ones from its start. seed: of these. outside: number of real scores
    outside the range.
    """

    score: str
    low: float
    high: float
    better: Literal["high", "low"]
    law: str
    radius: float
    rollouts: int
    seed: int
    outside: int
    mean: RealMean
    optimism: Optimism


class Trials(Struct, frozen=True, omit_defaults=True):
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
    simulated: Simulated | None = None
    """None: the runs were not simulated. Then there is no such key where it is written, as before there were simulated ones."""


class RunLimits(Struct, frozen=True):
    """Runs of a controller on the robot, and limits of the mean probability that such a run is unsafe (guarantee G10, `anytime`).

    certificate: under which they were driven; empty: under any. number, beta: of the sequence, and its share of the budget. The lower limit
    holds with confidence 1 - beta_lower, the upper with 1 - beta_upper, each after every run.
    """

    certificate: str
    number: int
    n: int
    unsafe: int
    censored: int
    lower: float
    upper: float
    beta_lower: float
    beta_upper: float


class Enclosure(Struct, frozen=True):
    """Scenarios compared with a tube that holds every run of the uncertain model (guarantee G13, `enclosure`).

    method: of the tube; rate: the stated one of the closed loop, because: the reason a person gave (0 and empty for `linear`). radius: of
    the gap set. n scenarios, `failed` not enclosed; upper: limit of the probability of that, at confidence 1-beta. reach: the
    tube's largest, m. rate_seen: the largest that drawn states showed.
    """

    method: Literal["linear", "rate"]
    rate: float
    because: str
    radius: float
    n: int
    failed: int
    upper: float
    beta: float
    seed: int
    reach: float
    rate_seen: float
    controller_digest: str
    model_digest: str
    task_digest: str


class InsideRuns(Struct, frozen=True):
    """Runs of certified controllers, and limits of the mean probability that a run has a residual outside the gap set (guarantee G13).

    radius: of the gap set, fixed before them. n runs count, `outside` of them left it or are not known. upper: at confidence 1-beta after
    every run. largest: residual of those that are known. own: runs of the controller that the statement is about; controllers: number of
    different ones among the n. capital: log of the largest capital against "it does not matter who drives", nats; level: of that
    test; refuted: then own runs alone count. logs: heads of the chains.
    """

    radius: float
    n: int
    outside: int
    upper: float
    beta: float
    largest: float
    own: int
    controllers: int
    capital: float
    level: float
    refuted: bool
    logs: tuple[str, ...] = ()


class Composition(Struct, frozen=True):
    """Both, and their sum: limit of the probability that a run of this controller on the robot is unsafe (guarantee G13)."""

    enclosure: Enclosure
    runs: InsideRuns | None
    upper: float


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
    fixed_seed: bool = False
    """Whether a simulation fixed the attempt's seed beforehand. Then it certifies nothing for a robot."""
