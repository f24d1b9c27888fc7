"""One robot = one TOML file. Loads it, validates it, and says on one line what is wrong: where, what it is, what it must be.

Everything a statement depends on is fixed here, before any data are seen. The profile's digest is bound into certificates.
"""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from s2r_runtime.bounded_file import MB, read_bounded
from s2r_runtime.canonical import canonical, digest_of
from s2r_runtime.errors import ConfigError
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile_checks import problems
from s2r_runtime.toml_text import parse_toml, read_text

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel


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
    """What the gap's statement says (guarantee G1, G4, G5)."""

    epsilon: float = 0.01
    """A new discrepancy exceeds the gap with at most this probability."""
    beta: float = 0.05
    """One minus the confidence, of all campaigns and verifications of the robot's life together."""
    alpha: float = 0.01
    """Probability of a false alarm of the watch, at most."""
    discard: int = 0
    """Largest discrepancies to leave out, fixed beforehand; each asks for more samples."""


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


AS_BEFORE: dict[str, dict[str, Any]] = {"gate": {"fault_share": 0.0, "fault_burst": 0}, "sampling": {"period": "first"}}
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


def load_driving_profile(path: Path) -> Profile:
    """As `load_profile`, for a robot that is to be driven: it must name its transport."""
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{path}: the name of the file, or of a folder on its way, is not UTF-8 text; rename it") from None
    profile = load_profile(path)
    if not profile.transport:
        raise ConfigError(f"{path}: transport is missing; to drive a robot, a profile must say how it is reached: [transport] name = ...")
    return profile


def load_profile(path: Path) -> Profile:
    """Reads and checks a profile. Raises ConfigError `path: field is value, must be ...`."""
    return parse_profile(read_text(path), str(path), path.parent)


def parse_profile(text: str, where: str, base: Path, files: Mapping[str, str] | None = None, *, as_before: Iterable[str] = ()) -> Profile:
    """As `load_profile`, from text; relative files are looked up from `base`. files: the transport's, by name, instead of the disk's.
    as_before: tables in which what the text lacks is as it was before the setting was there (`AS_BEFORE`), not today's default.
    """
    table = parse_toml(text, where)
    for name in as_before:
        if isinstance(given := table.get(name, {}), dict):
            table[name] = {**AS_BEFORE[name], **given}
    try:
        profile = msgspec.convert(table, Profile)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_explain(str(error), table)}") from None
    for field, value, must in problems(profile):
        raise ConfigError(f"{where}: {field} is {value}, must be {must}")
    try:
        canonical(table)
    except ValueError as error:  # nan and inf, wherever they stand: such a profile would have no digest
        raise ConfigError(f"{where}: {str(error).removeprefix('$.')}") from None
    transport = _with_files(profile.transport, where, base, files)
    return msgspec.structs.replace(profile, model=_resolved(profile.model, where, base), transport=transport)


def _covered(option: Any) -> Any:
    """What of a transport's option the profile's digest covers: of a file its normal form, where there is one, else its text."""
    return {name: option[name] for name in ("file", "stated")} if is_file(option) and "stated" in option else option


def _with_files(transport: dict[str, Any], where: str, base: Path, given: Mapping[str, str] | None) -> dict[str, Any]:
    """The transport's options, with the content of the files that they name (`Offer.files`), and the normal form of that, where the
    transport has one. A transport that isn't known has no files.
    """
    from s2r_runtime.plugins import registry

    found = registry()
    if transport.get("name") not in found.names("transports"):
        return transport
    options = _read_files(transport, found.offered("transports", transport["name"]).offer.files, where, base, given)
    normal_form = found.normal_form(transport["name"])
    with contextlib.suppress(ConfigError):  # the transport itself says what is wrong with it
        if normal_form is not None:
            plain = {name: value for name, value in options.items() if name != "name"}
            options = {name: {**v, "stated": normal_form(plain, name)} if is_file(v) else v for name, v in options.items()}
    return options


def _read_files(
    transport: dict[str, Any], named: tuple[str, ...], where: str, base: Path, given: Mapping[str, str] | None
) -> dict[str, Any]:
    options = dict(transport)
    for option in named:
        name = options.get(option)
        if not isinstance(name, str) or not name:
            continue  # the transport says what is wrong with it
        if given is not None:
            if name not in given:
                raise ConfigError(f"{where}: transport.{option}: {name} is not attached")
            options[option] = {"file": name, "text": given[name]}
            continue
        try:
            data = read_bounded(base / name, 16 * MB)
        except ConfigError as error:
            raise ConfigError(f"{where}: transport.{option}: {error}") from None
        try:
            options[option] = {"file": name, "text": data.decode("utf-8-sig")}
        except UnicodeDecodeError:  # older tools on Windows
            options[option] = {"file": name, "text": data.decode("cp1252", "replace")}
    return options


def _resolved(spec: ModelSpec, where: str, base: Path) -> ModelSpec:
    if not spec.name.endswith(".py"):
        return spec
    from s2r_runtime.models.composed import resolve_source  # numpy: only for models from a file

    return resolve_source(spec, base)


def check_names(profile: Profile, where: str) -> None:
    """Checks what needs the models, tasks and transports loaded: names of states and inputs, effects, task parameters."""
    from s2r_runtime.plugins import registry

    model = check_model(profile, where)
    if not profile.transport:
        return
    try:
        transport = registry().get("transports", str(profile.transport.get("name")))
    except ConfigError as error:
        raise ConfigError(f"{where}: transport.name: {error}") from None
    transport({k: v for k, v in profile.transport.items() if k != "name"}, model.states, model.inputs)


def check_model(profile: Profile, where: str) -> ComposedModel:
    """As `check_names`, all but the transport. Returns the profile's model, composed."""
    from s2r_runtime.models.composed import compose
    from s2r_runtime.plugins import registry

    model = compose(profile.model, f"{where}: model")
    for table, given, known in (
        ("region", profile.region, model.states),
        ("geofence", profile.geofence, model.states),
        ("norm.weights", profile.norm.weights, model.states),
        ("recovery.home", profile.recovery.home, model.states),
        ("inputs", profile.inputs, model.inputs),
        ("recovery.input", profile.recovery.input, model.inputs),
    ):
        for name in given:
            if name not in known:
                raise ConfigError(f"{where}: {table}.{name}: model {profile.model.name!r} has no such name; it has: {', '.join(known)}")
    if missing := [name for name in model.inputs if name not in profile.inputs]:
        raise ConfigError(f"{where}: inputs lacks bounds for {', '.join(missing)}")
    if missing := [name for name in model.states if name not in profile.region and name not in model.nominal.angles]:
        raise ConfigError(f"{where}: region lacks bounds for {', '.join(missing)}")
    try:
        task = registry().get("tasks", profile.task.name)
    except ConfigError as error:
        raise ConfigError(f"{where}: task.name: {error}") from None
    try:
        task(profile.task.parameters, model.nominal, profile.model.dt)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return model


def _explain(message: str, table: dict[str, Any]) -> str:
    """msgspec's `Expected X, got Y - at `$.a.b`` in this project's form."""
    path = re.search(r" - at `\$\.?([^`]*)`$", message)
    field = path.group(1) if path else ""
    text = message[: path.start()] if path else message
    if unknown := re.match(r"Object contains unknown field `(.*)`", text):
        place = f"{field}." if field else ""
        near = difflib.get_close_matches(unknown.group(1), _fields_at(field), 1, 0.6)
        return f"{place}{unknown.group(1)} is not a known setting" + (f"; did you mean {near[0]!r}?" if near else "")
    if missing := re.match(r"Object missing required field `(.*)`", text):
        return f"{field + '.' if field else ''}{missing.group(1)} is missing"
    value: Any = table
    for key in re.findall(r"[^.\[\]]+", field):
        value = value[int(key)] if isinstance(value, list) and key.isdigit() else value.get(key) if isinstance(value, dict) else None
    if wanted := re.match(r"Expected `(.*)`, got `(.*)`", text):
        return f"{field} is {value!r} ({wanted.group(2)}), must be {wanted.group(1)}"
    return f"{field}.{text}" if field else text


def _fields_at(field: str) -> list[str]:
    struct: Any = Profile
    for key in field.split(".") if field else []:
        names = {f.name: f.type for f in msgspec.structs.fields(struct)}
        struct = names.get(key)
        if not (isinstance(struct, type) and issubclass(struct, msgspec.Struct)):
            return []
    return [f.name for f in msgspec.structs.fields(struct)]
