"""Options that several verbs share: which model, which profile, and numbers with their ranges."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.errors import ConfigError, UsageError
from s2r_runtime.modelspec import ModelSpec, load_model
from s2r_runtime.profile import Profile, check_names, load_profile
from s2r_runtime.profile.checks import HEAVIEST, LIGHTEST
from s2r_runtime.recordings.units import number_of

if TYPE_CHECKING:
    from s2r_runtime.controllers.hosted import ControllerFile
    from s2r_runtime.models.composed import ComposedModel


def add_model_options(verb: argparse.ArgumentParser) -> None:
    """--profile, --model, --dt, --param, --column."""
    verb.add_argument("--profile", type=Path, metavar="P", help="the robot's profile (TOML): model, columns, weights")
    verb.add_argument(
        "--model",
        metavar="M",
        help="a model's name, a Python file, or a model TOML (docs/recordings.md; s2r trace -o writes one); replaces a profile's",
    )
    verb.add_argument(
        "--dt", type=positive, metavar="DT", help="the model's step in s (needed with a name or a Python file; else instead of the file's)"
    )
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the model; may be repeated")
    verb.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="the table's column of a state, an input, or t (the stamps), of another name (else as a profile says); may be repeated",
    )
    add_limit(verb)


def add_limit(verb: argparse.ArgumentParser) -> None:
    """--max-gb."""
    verb.add_argument("--max-gb", type=positive, metavar="GB", help="largest table that is read, as text, unpacked (default 4)")


def add_dbc(verb: argparse.ArgumentParser) -> None:
    """--dbc."""
    verb.add_argument(
        "--dbc", type=Path, metavar="FILE", help="of a CAN log: the file that says what its frames mean (DBC, KCD, SYM, ARXML)"
    )


def transport_of(args: argparse.Namespace, profile: Profile | None) -> dict[str, Any] | None:
    """The profile's transport; with --dbc that file alone, by which a CAN log has named signals."""
    if args.dbc is not None:
        return {"name": "can", "dbc": str(args.dbc)}
    return profile.transport if profile else None


def add_signal_options(verb: argparse.ArgumentParser) -> None:
    """--state, --input: which signal of a recording is what; --dbc."""
    add_dbc(verb)
    for option, what in (("--state", "state"), ("--input", "input")):
        verb.add_argument(
            option,
            action="append",
            default=[],
            metavar="NAME=SIGNAL",
            help=f"the signal that is this {what} of the model: TOPIC.FIELD, times a number if need be (*0.01); s2r topics lists them, "
            "usual names are guessed; may be repeated",
        )


def signals_of(args: argparse.Namespace, model: ComposedModel) -> dict[str, str]:
    """Name in the model -> signal, as --state and --input say. Raises UsageError."""
    found: dict[str, str] = {}
    for option, names in (("--state", model.states), ("--input", model.inputs)):
        what = option[2:]
        for item in getattr(args, what):
            name, sign, signal = (part.strip() for part in item.partition("="))
            if not name or not sign or not signal:
                raise UsageError(f"{option} {item}: must be NAME=SIGNAL, a name of the model and a signal of the recording")
            if name not in names:
                other = model.inputs if option == "--state" else model.states
                hint = f"; it is an{' input: --input' if option == '--state' else ' state: --state'} {item}" if name in other else ""
                raise UsageError(f"{option} {item}: the model has no {what} {name!r}{hint}; it has: {', '.join(names)}")
            if name in found:
                raise UsageError(f"{option} {item}: {name} is {found[name]} already")
            found[name] = signal
    return found


def columns_of(args: argparse.Namespace, model: ComposedModel, profile: Profile | None, *recordings: Path | None) -> dict[str, str]:
    """Name in the model, or `t` -> column of the table, where they differ: the profile's, and those of --column, or of --state and --input,
    instead. recordings: what is read. Raises UsageError for a name that the model does not have, or two on one column; and if there is no
    table for --column.
    """
    columns = dict(profile.columns) if profile else {}
    columns |= signals_of(args, model) if hasattr(args, "state") else {}
    if not args.column:
        return columns
    from s2r_runtime.modelspec import TIME
    from s2r_runtime.recordings.robot_logs import has_columns

    for path in recordings:
        if path is not None and not has_columns(path):
            raise UsageError(f"--column: belongs to a table; {path} is a log, whose states and inputs have their names")
    names = (*model.states, *model.inputs, TIME)
    asked: dict[str, str] = {}
    for item in args.column:
        name, sign, column = (part.strip() for part in item.partition("="))
        if not name or not sign or not column:
            raise UsageError(f"--column {item}: must be NAME=COLUMN, a state or an input of the model (or t, the stamps) and its column")
        if name not in names:
            raise UsageError(
                f"--column {item}: the model has no state or input {name!r}; it has: {', '.join(names[:-1])} (and t for the stamps)"
            )
        if name in asked:
            raise UsageError(f"--column {item}: {name} is in {asked[name]!r} already")
        asked[name] = column
    columns |= asked
    for name in asked:
        other = next((n for n in names if n != name and columns.get(n, n) == columns[name]), None)
        if other is not None:
            raise UsageError(
                f"--column {name}={columns[name]}: is the column of {other}, too; say where that is (--column {other}=COLUMN), or rename it"
            )
    return columns


def chosen_model(args: argparse.Namespace) -> tuple[ComposedModel, Profile | None]:
    """The model asked for, and the profile if one was named. Raises UsageError or ConfigError."""
    from s2r_runtime.models.composed import compose, resolve_source

    profile = load_checked(args.profile) if args.profile else None
    if args.model is None:
        if profile is None:
            raise UsageError("which model? give --profile P, or --model M --dt DT")
        spec, where = profile.model, str(args.profile)
    elif args.model.endswith(".toml"):
        spec, where = load_model(Path(args.model)), args.model
    else:
        dt = args.dt if args.dt is not None else profile.model.dt if profile else None
        if dt is None:
            raise UsageError(f"--model {args.model} needs its step: --dt DT (s)")
        spec, where = _named(args.model, dt), "--model"
    if args.dt is not None:
        spec = _with_dt(spec, args.dt)
    spec = resolve_source(spec, Path.cwd())
    if not args.param:
        return compose(spec, where), profile
    asked = msgspec.structs.replace(spec, parameters={**spec.parameters, **dict(pair(item, "--param") for item in args.param)})
    try:
        return compose(asked, where), profile
    except ConfigError as error:
        compose(spec, where)  # a model that is wrong without them too says so itself
        raise UsageError(str(error).replace(f"{where}.parameters.", "--param ")) from None


def controller_at(path: Path, parameters: list[str]) -> ControllerFile:
    """The controller in that file. Raises UsageError if there is no such file, ConfigError if it is no controller."""
    from s2r_runtime.controllers import hosted as controllers

    if not path.is_file():
        raise UsageError(f"{path}: no such file; a controller is a Python file with control(x, theta, parameters)")
    asked = dict(pair(item, "--param") for item in parameters)
    try:
        return controllers.load(path, asked)
    except ConfigError as error:
        if not asked:
            raise
        controllers.load(path, {})  # a file that is wrong without them too says so itself
        raise UsageError(f"--param: {error}") from None


def writable(path: Path | None, *, replaced: bool = False) -> None:
    """Refuses a place where no file can be written, before the work whose result it is for. Raises UsageError.

    replaced: a new file takes its place (`persistence.replace`), which the folder must allow, whatever the old one does.
    """
    if path is None:
        return
    folder = path.parent
    if path.is_dir():
        raise UsageError(f"{path}: is a folder, must be a file")
    if not folder.is_dir():
        raise UsageError(f"{path}: cannot be written: there is no folder {folder}")
    if not os.access(path if path.exists() and not replaced else folder, os.W_OK):
        raise UsageError(f"{path}: cannot be written: permission denied")


def apart(outputs: Mapping[str, Path | None], inputs: Mapping[str, Path | str | None]) -> None:
    """Refuses an output that would take the place of a file that is read, or of another output. Raises UsageError.

    outputs: option -> path. inputs: what a file is, in words -> path (or a name that is no file's).
    """
    read = {what: Path(path) for what, path in inputs.items() if path is not None}
    for option, path in outputs.items():
        if path is None:
            continue
        for what, other in read.items():
            if _same_file(path, other):
                raise UsageError(f"{option} {path}: is {what}, which would be lost; name another file")
        read[f"the file of {option}"] = path


def own_file(spec: ModelSpec) -> str | None:
    """The Python file that a model is in, if it is somebody's own: a TOML or a profile may name it."""
    return spec.name if spec.name.endswith(".py") else None


def _same_file(one: Path, other: Path) -> bool:
    """Whether writing to one changes the other. A device (/dev/null) takes any number of writers."""
    if one.exists() and other.exists():
        return one.is_file() and one.samefile(other)
    return one.resolve() == other.resolve()


def load_checked(path: Path) -> Profile:
    """A profile whose names of models, states, tasks and transports were checked too."""
    profile = load_profile(path)
    check_names(profile, str(path))
    return profile


def weights_of(states: tuple[str, ...], given: list[str], profile: Profile | None) -> tuple[float, ...]:
    """(nx,) weights: from --weight STATE=W, else the profile's, else 1. Raises UsageError for an unknown state or W <= 0."""
    weights = dict(profile.norm.weights) if profile else {}
    for item in given:
        name, value = pair(item, "--weight")
        if name not in states:
            raise UsageError(f"--weight {item}: the model has no state {name!r}; it has: {', '.join(states)}")
        if not LIGHTEST <= value <= HEAVIEST:
            raise UsageError(f"--weight {item}: must be > 0, from {LIGHTEST:g} to {HEAVIEST:g}")
        weights[name] = value
    return tuple(weights.get(name, 1.0) for name in states)


def probability(text: str) -> float:
    """argparse type: a number strictly between 0 and 1."""
    try:
        value = number_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"{text} must be between 0 and 1")
    return value


def positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    try:
        value = number_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} must be > 0 and finite")
    return value


def not_negative(text: str) -> float:
    """argparse type: a finite number >= 0."""
    try:
        return 0.0 if text.strip("0.") == "" and "0" in text else positive(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(str(error).replace("> 0", ">= 0")) from None


def count(text: str) -> int:
    """argparse type: a whole number >= 0."""
    if not (text.isdecimal() and text.isascii()):
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number >= 0")
    return int(text)


def _named(name: str, dt: float) -> ModelSpec:
    try:
        return ModelSpec(name, dt)
    except ValueError as error:
        raise UsageError(f"--dt: {error}") from None


def _with_dt(spec: ModelSpec, dt: float) -> ModelSpec:
    if spec.fitted_on and dt != spec.dt:
        raise ConfigError(f"--dt {dt}: the model was fitted at a step of {spec.dt} s; its effects hold for that step")
    return msgspec.structs.replace(spec, dt=dt)


def pair(item: str, option: str) -> tuple[str, float]:
    """NAME=NUMBER. Raises UsageError naming the option."""
    name, sign, value = item.partition("=")
    try:
        number = number_of(value)
    except ValueError:
        number = float("nan")
    if not sign or not name or not abs(number) < float("inf"):
        raise UsageError(f"{option} {item}: must be NAME=NUMBER, finite")
    return name, number
