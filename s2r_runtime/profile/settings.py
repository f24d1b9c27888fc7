"""The settings of a profile: one robot = one TOML file (docs/profile.md).

Everything a statement depends on is fixed here, before any data are seen. The profile's digest is bound into certificates.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from s2r_runtime.files.canonical import digest_of
from s2r_runtime.modelspec import ModelSpec


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the profile's tables. What stands below a setting is its row in docs/profile.md (`tools/profile_reference.py`)."""


class Robot(_Table, frozen=True):
    """Who it is."""

    name: str
    """Keys its state, sockets and topics: lower-case letters, digits, - and _."""
    description: str = ""
    """For people."""


class Norm(_Table, frozen=True):
    """The norm of the discrepancy, fixed before the data are seen."""

    set: Literal["ball", "box"] = "ball"
    """Shape of the gap set: `ball` for `sqrt(sum (w e)^2)`, `box` for `max w |e|`."""
    weights: dict[str, float] = {}
    """By state, each in norm-units per state-unit; a state left out weighs 1."""


class Sampling(_Table, frozen=True):
    """The campaign: goes to a random place, stops, and applies a random input."""

    n: int = 0
    """Samples, fixed beforehand; 0: as many as the epoch's share of beta asks for."""
    hold_periods: int = 50
    """For how many periods each input is held. One of them gives the sample, the end of the last one the hold gap."""
    period: Literal["random", "first"] = "random"
    """Which period of each hold gives the sample. `random`: drawn uniformly, so that the robot is moving as it does when it is driven.
    `first`: from a full stop, as in the paper; blind to whatever acts late.
    """
    stop_periods: int = 4
    """Periods of zero input before a sample begins, at least the robot's delay + 1."""
    waypoint_radius: float = 0.1
    """m; a waypoint is reached when the robot is nearer than this."""
    waypoint_margin: float = 0.15
    """m; waypoints are drawn this far inside region and geofence."""
    waypoint_timeout: float = 60.0
    """s; a waypoint that is not reached by then is given up for another one."""
    position_gain: float = 1.0
    """1/s; of the go-to law, on the distance."""
    heading_gain: float = 3.0
    """1/s; of the go-to law, on the bearing."""
    stuck_after: float = 5.0
    """s; a robot that was commanded for so long and did not move is stuck."""
    max_rejections: int = 200
    """Samples that may be rejected in all before the campaign gives up."""
    seed: int = 1
    """Of all draws, together with robot, model, profile and epoch; `s2r run --seed` replaces it."""


class Driving(_Table, frozen=True):
    """Whether ordinary driving may found a gap, and on which assumption (guarantee G4). Left out, it may not."""

    block: float = 0.0
    """s; transitions so far apart are taken to be `mixing`-close to independent. 0: driving founds nothing."""
    mixing: float = 0.0
    """A bound on the beta-mixing coefficient of the blocks, 0: independent."""
    because: str = ""
    """Why that may be assumed. There must be a reason where there are blocks; it stands in the statement."""


class Guarantee(_Table, frozen=True):
    """What the statements about gap and runs say (guarantee G1, G4, G5, G10)."""

    epsilon: float = 0.01
    """A new discrepancy exceeds the gap with at most this probability."""
    beta: float = 0.05
    """One minus the confidence, of all campaigns and verifications of the robot's life together."""
    alpha: float = 0.01
    """Probability of a false alarm of the watch, at most."""
    discard: int = 0
    """Largest discrepancies to leave out, fixed beforehand; each asks for more samples."""
    beta_episodes: float = 0.1
    """One minus the confidence of all limits of unsafe runs in the robot's life together. The first controller's upper limit has 45.6 % of
    it, so by default a confidence of 95.4 %."""
    max_unsafe: float = 0.0
    """A controller is revoked and refused when the lower limit of its unsafe runs is above this. 0: none is."""
    beta_composition: float = 0.1
    """One minus the confidence of all composed statements in the robot's life together (guarantee G13). Verification attempt j has
    6 beta / (pi² j²) of it: half for the runs, half for the scenarios."""
    gate_closing: Literal["unsafe", "safe", "censored"] = "unsafe"
    """What a run counts as in which the gate closed while its safety value was good. `censored`: as unsafe in the upper limit, as safe in
    the lower one. A run in which the controller itself failed is always unsafe."""


class VerificationSettings(_Table, frozen=True):
    """Rollouts of the uncertain model (guarantee G2, G8)."""

    epsilon: float = 0.01
    """A new rollout scores below the worst of these with at most this probability."""
    n: int = 0
    """Scenarios for each law; 0: as many as the attempt's share of beta asks for."""
    threshold: float = 0.0
    """Safety value that every rollout must reach."""
    headroom: float = 3.0
    """The largest radius at which the controller passes is looked for up to so many times the gap; growth below it costs nothing."""
    laws: tuple[Literal["uniform", "persistent", "adversarial"], ...] = ("uniform", "persistent", "adversarial")
    """Disturbance laws that are run and reported."""
    required: tuple[Literal["uniform", "persistent", "adversarial"], ...] = ("uniform", "persistent")
    """Those of them that must pass."""
    max_optimism: float = 1.0
    """It must be shown that the uncertain model's share of safe runs exceeds the robot's by at most this (guarantee G12); 1: no demand.
    Below 1, a certificate needs trials (`s2r certify --trials`): the daemon issues none by itself, and takes one that is brought.
    """
    run_radius: float = 0.0
    """A run stays in the gap set if each of its residuals is at most this, in the norm's unit (guarantee G13). It is fixed before the runs:
    only runs that are driven under it count. 0: none is meant."""
    timeout: float = 60.0
    """s; a controller that is not done by then has not passed. Time in which it waits for a processor does not count."""


TaskLaw = float | str | list[float] | dict[str, list[float]]
TaskValue = float | str | list[float] | dict[str, TaskLaw]
"""What a task's parameter may be; most are numbers, the task `stl` has texts and tables."""


class TaskChoice(_Table, frozen=True):
    """What the controller is asked to do."""

    name: str
    """A task that is built in or comes from a plug-in (`s2r plugin list`)."""
    parameters: dict[str, TaskValue] = {}
    """Its own: below, or on the page of tasks."""
    episodes: int = 0
    """Scenarios that are driven one after the other once deployed; 0: no end."""


class Gate(_Table, frozen=True):
    """What closes the gate in time, and what keeps it closed."""

    observation_timeout: float = 0.2
    """s; an observation that is older closes the gate."""
    command_ttl: float = 0.1
    """s; for how long a command is good, and how long an answer may take."""
    controller_deadline: float = 0.05
    """s; a controller that has not answered by then is at fault. In lockstep it has `machine.process_timeout` at least."""
    hysteresis: float = 0.1
    """s; the gate opens when nothing has stood against it for so long."""
    settle_periods: int = 30
    """In lockstep, with nobody to ask: so many instants get the recovery command, then the robot waits."""
    latching: tuple[str, ...] = (
        "emergency_stop",
        "manual_override",
        "watch_alarm",
        "controller_fault",
        "command_invalid",
        "measurement_faults",
    )
    """Reasons that stay until a person clears them (`s2r clear`); besides `emergency_stop`, `manual_override`, `robot_twin` and
    `observation_faults`, which always do."""
    fault_share: float = 0.1
    """Of the observations, so many may be malformed, echoed, late or another's; more latch the gate with `observation_faults`. 0: no such
    bound. A sound link stays below 0.01; a copy of the stream, or a second robot, makes 0.5."""
    fault_burst: int = 10
    """So many of them at once are no reason yet: a network that stalls for a moment brings some."""


class Recovery(_Table, frozen=True):
    """What drives when the gate is closed."""

    kind: Literal["stop", "hold", "return"] = "stop"
    """`stop`: zero input; `hold`: a fixed `input`; `return`: to `home`, then stop."""
    input: dict[str, float] = {}
    """For `hold`, by input, within its bounds; an input left out is 0."""
    home: dict[str, float] = {}
    """For `return`, by state, inside the geofence; a state left out is 0."""


class Watch(_Table, frozen=True):
    """What is made of discrepancies while a controller drives (guarantee G5)."""

    fault_jump: float = 0.0
    """In the norm's unit; a discrepancy above it is a fault of measurement, not motion. 0: twice the norm of the geofence's extent, which
    no motion reaches.
    """
    max_faults: int = 20
    """More of these in a deployment close the gate."""
    run_length: float = 1e5
    """Discrepancies between two false notices of a change, at least, on average."""


class CertificateSettings(_Table, frozen=True):
    """What a certificate is given."""

    lifetime: float = 86400.0
    """s; for how long it is valid."""


class Recording(_Table, frozen=True):
    """Where logs go, and how many are kept: never is one deleted on which a valid certificate rests."""

    directory: str = "logs"
    """Relative to the state folder."""
    rotate_bytes: int = 1_000_000_000
    """A new file begins when one is so large; 0: not for its size."""
    rotate_after: float = 0.0
    """s; a new file begins when one is so old; 0: not for its age."""
    keep_bytes: int = 0
    """Of all logs; the oldest runs beyond are deleted. 0: all are kept."""
    keep_days: float = 0.0
    """Older runs are deleted. 0: all are kept."""
    max_delay: float = 0.5
    """s; so much of the log may wait for the disk, and be lost in a crash, while the gate is open. More closes it (`recorder_down`) until
    it is written; in lockstep the robot is kept waiting instead. The default is ten times the 0.05 s between two writes."""


class Machine(_Table, frozen=True):
    """How long the computer's own disk and processes are waited for. No bound on the robot's data or commands is among these, and a
    certificate is not bound to them: a quicker computer is no other robot. `s2r doctor --load` measures what this computer needs.
    """

    disk_timeout: float = 5.0
    """s; so long is the disk waited for where something must be on it before it takes effect (an opening of the gate, a certificate), and
    the gate's loop stands still meanwhile. Then it does not take effect. In lockstep 30 s at least. The default: syncs of a busy disk
    took 1 to 2 s."""
    watch_delay: float = 2.0
    """s; so far may the watch be behind the robot while a controller drives. More closes the gate (`analytics_down`) until it has caught
    up. The default: a step of a model takes 1 ms, and a busy computer let a process wait for up to 1.5 s."""
    process_timeout: float = 10.0
    """s; analytics that is silent for so long counts as hung, and is started anew; in lockstep, where the robot waits, a controller is at
    fault. The default: some six times the longest wait for a processor that was seen, 1.5 s."""
    start_timeout: float = 30.0
    """s; until analytics, or a controller, has loaded its libraries. The default: ten times what a small computer needs, its disk cold."""


class Repair(_Table, frozen=True):
    """When the residual is traced without being asked for, and whose decision it is to use a repaired model."""

    after_campaign: bool = False
    """After every campaign."""
    after_inputs: bool = False
    """After given inputs (`s2r sample --inputs`)."""
    on_growth: bool = False
    """When the gap grew while a controller drives, and again when it has grown by a tenth more."""
    delay: float = 10.0
    """s; of driving after the gap grew, before that is traced: so that there is something to see."""
    rows: int = 40_000
    """Observations that are traced at most, the newest."""
    timeout: float = 600.0
    """s; then a trace is ended, and the log says so. Time in which it waits for a processor does not count."""
    adopt: Literal["ask", "always"] = "ask"
    """`ask`: a person adopts it (`s2r adopt`); `always`: it is in force as soon as nothing drives."""


AS_BEFORE: dict[str, dict[str, Any]] = {
    "gate": {"fault_share": 0.0, "fault_burst": 0},
    "sampling": {"period": "first"},
    "guarantee": {"beta_episodes": 0.1, "max_unsafe": 0.0, "gate_closing": "unsafe", "beta_composition": 0.1},
    "verification": {"max_optimism": 1.0, "run_radius": 0.0},
}
"""Settings that were added later: table -> setting -> the value by which everything was done before it was there. A log is audited, and a
digest computed, as if a profile with that value did not have the setting.
"""


def plain_table(name: str, table: _Table) -> Any:
    """A table as plain data for a digest; without the settings that have the value of before they were there."""
    plain = msgspec.to_builtins(table)
    for setting, before in AS_BEFORE.get(name, {}).items():
        if plain[setting] == before:
            del plain[setting]
    return plain


class Profile(_Table, frozen=True):
    """A robot."""

    robot: Robot
    model: ModelSpec
    region: dict[str, tuple[float, float]]
    """Where samples count and certificates hold: `[low, high]` by state; an angle may be left out (all of it)."""
    inputs: dict[str, tuple[float, float]]
    """`[low, high]` by input, around 0: the robot stops on zero input."""
    task: TaskChoice
    transport: dict[str, Any] = {}
    """How the robot is reached: `name`, and that transport's options. What is computed from recordings and models alone needs none."""
    geofence: dict[str, tuple[float, float]] = {}
    """Where the sampler may drive, by state; a state left out is fenced by the region."""
    columns: dict[str, str] = {}
    """Name of the model's -> column of a recording, where they differ."""
    norm: Norm = Norm()
    sampling: Sampling = Sampling()
    driving: Driving = Driving()
    guarantee: Guarantee = Guarantee()
    verification: VerificationSettings = VerificationSettings()
    gate: Gate = Gate()
    recovery: Recovery = Recovery()
    watch: Watch = Watch()
    certificate: CertificateSettings = CertificateSettings()
    recording: Recording = Recording()
    machine: Machine = Machine()
    repair: Repair = Repair()
    clock: Literal["realtime", "lockstep"] = "realtime"
    """`lockstep`: the robot's clock is the clock, and stands still while nobody answers (a simulation)."""

    @property
    def files(self) -> dict[str, str]:
        """Name as written in the profile -> text, of the files that its transport names (`Offer.files`)."""
        named = [value for value in self.transport.values() if is_file(value)]
        return {value["file"]: value["text"] for value in named}

    def digest(self) -> str:
        """Digest of everything but the model (it has a digest of its own), where logs go, and what the computer is given time for."""
        plain = msgspec.to_builtins(self)
        del plain["model"], plain["recording"], plain["machine"]
        plain["transport"] = {name: _covered(value) for name, value in self.transport.items()}
        return digest_of({**plain, **{name: plain_table(name, getattr(self, name)) for name in AS_BEFORE if name in plain}})

    def by_text(self) -> Profile:
        """The same, with a digest that covers the whole text of each file that its transport names, as earlier versions computed it."""
        whole = {name: {"file": v["file"], "text": v["text"]} if is_file(v) else v for name, v in self.transport.items()}
        return msgspec.structs.replace(self, transport=whole)

    def task_digest(self) -> str:
        """Digest of the task: its name, parameters, threshold and the model step it runs on."""
        return digest_of(
            {"task": self.task.name, "parameters": self.task.parameters, "dt": self.model.dt, "threshold": self.verification.threshold}
        )


def is_file(option: Any) -> bool:
    """Whether a transport's option is a file with its content: `{"file": ..., "text": ...}`, and `"stated"` of a transport that has it."""
    return isinstance(option, dict) and {"file", "text"} <= set(option) <= {"file", "text", "stated"}


def _covered(option: Any) -> Any:
    """What of a transport's option the profile's digest covers: of a file its normal form, where there is one, else its text."""
    return {name: option[name] for name in ("file", "stated")} if is_file(option) and "stated" in option else option
