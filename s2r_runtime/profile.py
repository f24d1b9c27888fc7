"""One robot = one TOML file. Loads it, validates it, and says on one line what is wrong: where, what it is, what it must be.

Everything a statement depends on is fixed here, before any data are seen. The profile's digest is bound into certificates.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from s2r_runtime.canonical import canonical, digest_of
from s2r_runtime.errors import ConfigError
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile_checks import problems

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the profile's tables."""


class Robot(_Table, frozen=True):
    """Who it is. `name` keys state, sockets and topics."""

    name: str
    description: str = ""


class Norm(_Table, frozen=True):
    """The norm of the discrepancy. Weights by state, each in norm-units per state-unit; a state left out weighs 1."""

    set: Literal["ball", "box"] = "ball"
    weights: dict[str, float] = {}


class Sampling(_Table, frozen=True):
    """The campaign (paper, section V). `stop_periods`: zero input before x0 is recorded, at least the robot's delay + 1.

    `n` 0: as many samples as the epoch's share of beta asks for. Times in s, lengths in m, gains of the go-to law in 1/s.
    """

    n: int = 0
    hold_periods: int = 50
    stop_periods: int = 4
    waypoint_radius: float = 0.1
    waypoint_margin: float = 0.15
    waypoint_timeout: float = 60.0
    position_gain: float = 1.0
    heading_gain: float = 3.0
    stuck_after: float = 5.0
    max_rejections: int = 200
    seed: int = 1


class Driving(_Table, frozen=True):
    """Whether ordinary driving may found a gap, and on which assumption: `block` s apart, transitions are `mixing`-close to independent (a
    bound on the beta-mixing coefficient, 0: independent), `because` of what. block 0: driving founds nothing.
    """

    block: float = 0.0
    mixing: float = 0.0
    because: str = ""


class Guarantee(_Table, frozen=True):
    """epsilon, beta of guarantee G1 to G4, alpha of the watch's alarm, k discarded samples."""

    epsilon: float = 0.01
    beta: float = 0.05
    alpha: float = 0.01
    discard: int = 0


class VerificationSettings(_Table, frozen=True):
    """`headroom`: verification finds the largest radius at which the controller passes, up to headroom times the gap's, so that growth
    below it costs nothing.

    `n` 0: as many as the attempt's share of beta asks for. `required`: the laws that must pass; the others are reported.
    """

    epsilon: float = 0.01
    n: int = 0
    threshold: float = 0.0
    headroom: float = 3.0
    laws: tuple[Literal["uniform", "persistent", "adversarial"], ...] = ("uniform", "persistent", "adversarial")
    required: tuple[Literal["uniform", "persistent", "adversarial"], ...] = ("uniform", "persistent")
    timeout: float = 60.0


TaskLaw = float | str | list[float] | dict[str, list[float]]
TaskValue = float | str | list[float] | dict[str, TaskLaw]
"""What a task's parameter may be; most are numbers, the task `stl` has texts and tables."""


class TaskChoice(_Table, frozen=True):
    """Which task, its parameters, and how many scenarios are driven one after the other once deployed (0: no end)."""

    name: str
    parameters: dict[str, TaskValue] = {}
    episodes: int = 0


class Gate(_Table, frozen=True):
    """Time-outs in s. `latching`: reasons that stay until a person clears them."""

    observation_timeout: float = 0.2
    command_ttl: float = 0.1
    controller_deadline: float = 0.05
    hysteresis: float = 0.1
    settle_periods: int = 30
    latching: tuple[str, ...] = (
        "emergency_stop",
        "manual_override",
        "watch_alarm",
        "controller_fault",
        "command_invalid",
        "measurement_faults",
    )


class Recovery(_Table, frozen=True):
    """What drives when the gate is closed: `stop` (zero input), `hold` (a fixed `input`), `return` (to `home`, then stop)."""

    kind: Literal["stop", "hold", "return"] = "stop"
    input: dict[str, float] = {}
    home: dict[str, float] = {}


class Watch(_Table, frozen=True):
    """`fault_jump`: a discrepancy above it (in the norm's unit) is a fault of measurement, not motion; 0: there is no such rule.
    More than `max_faults` of them in a deployment close the gate.

    `run_length`: discrepancies between two false notices of a change, at least, on average.
    """

    fault_jump: float = 0.0
    max_faults: int = 20
    run_length: float = 1e5


class CertificateSettings(_Table, frozen=True):
    """How long a certificate is valid, in s."""

    lifetime: float = 86400.0


class Recording(_Table, frozen=True):
    """Where logs go (relative to the state folder), when they rotate (bytes, s; 0: never).

    keep_bytes, keep_days: of all logs; the oldest runs beyond are deleted, but never what a valid certificate rests on (0: all are kept).
    """

    directory: str = "logs"
    rotate_bytes: int = 1_000_000_000
    rotate_after: float = 0.0
    keep_bytes: int = 0
    keep_days: float = 0.0


class Repair(_Table, frozen=True):
    """When the residual is traced without being asked for: after a campaign, after given inputs, or `delay` s after the gap grew while a
    controller drives. `rows`: observations at most, the newest. `timeout` in s.

    `adopt`: a repaired model is used when a person says so (`ask`), or as soon as nothing drives (`always`).
    """

    after_campaign: bool = False
    after_inputs: bool = False
    on_growth: bool = False
    delay: float = 10.0
    rows: int = 40_000
    timeout: float = 600.0
    adopt: Literal["ask", "always"] = "ask"


class Profile(_Table, frozen=True):
    """A robot. region: where the certificate holds, bounds by state (an angle may be left out: all of it).

    transport: empty where nobody is to drive: what is computed from recordings and models alone needs none.
    """

    robot: Robot
    model: ModelSpec
    region: dict[str, tuple[float, float]]
    inputs: dict[str, tuple[float, float]]
    task: TaskChoice
    transport: dict[str, Any] = {}
    geofence: dict[str, tuple[float, float]] = {}
    columns: dict[str, str] = {}
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
    repair: Repair = Repair()
    clock: Literal["realtime", "lockstep"] = "realtime"

    @property
    def files(self) -> dict[str, str]:
        """Name as written in the profile -> text, of the files that its transport names (`Offer.files`)."""
        named = [value for value in self.transport.values() if isinstance(value, dict) and set(value) == {"file", "text"}]
        return {value["file"]: value["text"] for value in named}

    def digest(self) -> str:
        """Digest of everything but the model (it has a digest of its own) and where logs go."""
        plain = msgspec.to_builtins(self)
        del plain["model"], plain["recording"]
        return digest_of(plain)

    def task_digest(self) -> str:
        """Digest of the task: its name, parameters, threshold and the model step it runs on."""
        return digest_of(
            {"task": self.task.name, "parameters": self.task.parameters, "dt": self.model.dt, "threshold": self.verification.threshold}
        )


def load_driving_profile(path: Path) -> Profile:
    """As `load_profile`, for a robot that is to be driven: it must name its transport."""
    profile = load_profile(path)
    if not profile.transport:
        raise ConfigError(f"{path}: transport is missing; to drive a robot, a profile must say how it is reached: [transport] name = ...")
    return profile


def load_profile(path: Path) -> Profile:
    """Reads and checks a profile. Raises ConfigError `path: field is value, must be ...`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None
    return parse_profile(text, str(path), path.parent)


def parse_profile(text: str, where: str, base: Path, files: Mapping[str, str] | None = None) -> Profile:
    """As `load_profile`, from text; relative files are looked up from `base`. files: the transport's, by name, instead of the disk's."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not TOML: {error}") from None
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


def _with_files(transport: dict[str, Any], where: str, base: Path, given: Mapping[str, str] | None) -> dict[str, Any]:
    """The transport's options, with the content of the files that they name (`Offer.files`). A transport that isn't known has none."""
    from s2r_runtime.plugins import registry

    found = registry()
    if transport.get("name") not in found.names("transports"):
        return transport
    options = dict(transport)
    for option in found.offered("transports", transport["name"]).offer.files:
        name = options.get(option)
        if not isinstance(name, str) or not name:
            continue  # the transport says what is wrong with it
        if given is not None:
            if name not in given:
                raise ConfigError(f"{where}: transport.{option}: {name} is not attached")
            options[option] = {"file": name, "text": given[name]}
            continue
        try:
            data = (base / name).read_bytes()
        except OSError as error:
            raise ConfigError(f"{where}: transport.{option}: {base / name}: cannot be read: {error.strerror}") from None
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
