"""What the core is told at its start: the profile's settings, and the memory that outlives a restart."""

from __future__ import annotations

from typing import Literal

from s2r_runtime.messages.link import Struct
from s2r_runtime.messages.results import CertificateFacts, Gap

Stretch = Literal["campaign", "drive", "inputs"]
"""What a trace is made on: the newest campaign; what controllers drove since its gap came into force; the newest drive of given inputs."""


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
    fault_share: float = 0.0
    fault_burst: int = 0
    """The share of observations that may be faulty, and how many may be so at once; share 0: a run before there was such a bound."""

    rules: int = 0
    """Of the core's rules, those that the run was made by; a log of before has 0 and is audited by them. See `RULES`."""
    any_step: bool = False
    """Whether the model and its effects step exactly at any length, so that a transition may last longer than one step (rules 2)."""
    simulated: bool = False
    """Whether the seeds of verifications are fixed, so that a simulation can be repeated (rules 9)."""
    beta_episodes: float = 0.0
    """One minus the confidence of all limits of unsafe runs together (guarantee G10, rules 11). 0: a run before they were counted."""
    max_unsafe: float = 0.0
    """A lower limit above this revokes. 0: none does."""
    gate_closing: Literal["unsafe", "safe", "censored"] = "unsafe"
    """What a run counts as in which the gate closed."""
    threshold: float = 0.0
    """Safety value below which a run is unsafe."""
    run_radius: float = 0.0
    """Residuals up to this are in the gap set of a composed statement (guarantee G13). 0: none is meant. The core does not use it."""


GRID = 2
"""Since these rules control instants stand on the model's grid, and transitions are compared with a step of their own length. Before, an
instant came 0.9 dt after the last one, and a transition could be 0.2 dt off a step.
"""
RESTARTS = 4
"""Since these rules nothing is measured across a restart of the robot or a lost link, and no command from before acts after it."""
SEEDS = 5
"""Since these rules the seed of a verification is drawn after its attempt was paid for. Before, it was a function of digests and attempt
number, which anybody could compute beforehand.
"""
LATEST_TIME = 6
"""Since these rules the wall clock never goes back: `core.wall_clock`."""
IMPLAUSIBLE = 7
"""Since these rules `watch.fault_jump = 0` is a bound that follows from the geofence. Before, it was none."""
REFUSED_FIRST = 8
"""Since these rules no attempt is spent on a certificate that `deploy` would refuse for what driving showed (`core.driven`)."""
FIXED_SEEDS = 9
"""Since these rules a certificate whose seed a simulation fixed says so, and drives only in a simulation."""
UNKNOWN_PAST = 10
"""Since these rules nothing is measured after that until commands from before it cannot matter any more, however long effects remember."""
EPISODES = 11
"""Since these rules every run of a certified controller is counted, and limits of its unsafe runs hold at all times (`core.runs`)."""
RULES = 11
"""1: a campaign that is refused for dependent samples is remembered, and can be traced and repeated. 2: `GRID`. 3: what driving showed is
kept over epochs (`Driven`). 4: `RESTARTS`. 5: `SEEDS`. 6: `LATEST_TIME`. 7: `IMPLAUSIBLE`. 8: `REFUSED_FIRST`. 9: `FIXED_SEEDS`.
10: `UNKNOWN_PAST`. 11: `EPISODES`.
"""
BEHAVIOURS = 1000
"""Remembered on one gap: some 20 KB of what is persisted. Beyond that a certificate says *at least*."""
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


class RefusedCampaign(Struct, frozen=True):
    """A campaign whose samples depend on each other (guarantee G1). It bounds no gap; its share `beta` is spent. Its data can be traced.

    reason: the test's, with its p-value. in_a_row: campaigns that were refused since the last gap, this one included.
    """

    epoch: int
    n: int
    beta: float
    reason: str
    in_a_row: int = 1


class Driven(Struct, frozen=True):
    """What the watch of an epoch showed of the discrepancy while driving, in its model and norm (`core.driven`).

    lower, upper: limits of its (1-epsilon)-quantile at all times at once, each with confidence 1-alpha; None: none yet. n: steps.
    """

    model_digest: str
    set: Literal["ball", "box"]
    weights: tuple[float, ...]
    epsilon: float
    epoch: int
    n: int
    lower: float | None
    upper: float | None


class RunCounts(Struct, frozen=True):
    """Runs of one controller on this robot (certificate empty), or under one certificate, since its sequence began (guarantee G10).

    number: of the sequence among all of this robot's; beta: its share of the budget. unsafe, censored: of the n runs. exceeded: its lower
    limit was above `Settings.max_unsafe` once.
    """

    controller: str
    certificate: str
    number: int
    beta: float
    n: int = 0
    unsafe: int = 0
    censored: int = 0
    exceeded: bool = False


class OpenRun(Struct, frozen=True):
    """A controller that may be driving a run while this is in the memory. Found at a start, that run was cut: it counts as censored."""

    controller: str
    certificate: str


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
    refused_campaign: RefusedCampaign | None = None
    """The newest campaign, if its samples depend on each other; None as soon as a later one found a gap."""
    driven: tuple[Driven, ...] = ()
    """What driving showed in the epochs before this one: of each model, norm and quantile the epoch where it was worst."""
    gap_attempts: int = 0
    """Verification attempts on the gap in force, as far as they were counted (rules 5)."""
    behaviours: tuple[str, ...] = ()
    """Of the controllers tried on it, each once, the newest `BEHAVIOURS`: `JobFinished.behaviour`, else the controller's digest."""
    clock_cleared: int = 0
    """How often a person said that the clock is right although it is behind the latest time."""
    latest_unix_s: int = 0
    """The latest time of day that was ever believed, s since 1970 (0: not said). An earlier clock is not: see `core.wall_clock`."""
    runs: tuple[RunCounts, ...] = ()
    """Runs of controllers on this robot, the newest controller last (`core.runs`)."""
    run_sequences: int = 0
    """How many sequences of runs began; each has its own share of `Settings.beta_episodes`."""
    open_run: OpenRun | None = None
    """Who drives, or did when the daemon was cut."""
    drives: int = 0
    """How often a controller was to start, and how often one ended: together, so that it only grows."""
    runs_cleared: int = 0
    """How often a person discarded the runs of controllers that exceeded `Settings.max_unsafe`."""
