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
