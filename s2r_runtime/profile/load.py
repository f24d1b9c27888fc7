"""Reads a profile, checks it, and reports in one line what is wrong: where, what it is, what it must be."""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.bounded_file import MB, read_bounded
from s2r_runtime.files.canonical import canonical
from s2r_runtime.files.toml_text import parse_toml, read_text
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile.checks import problems
from s2r_runtime.profile.settings import AS_BEFORE, Profile, is_file

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel


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
