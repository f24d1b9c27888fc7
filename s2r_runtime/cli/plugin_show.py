"""`s2r plugin show NAME`: what a model, an effect, a task or a transport is, with its numbers, units and channels."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from s2r_runtime.cli import output
from s2r_runtime.errors import ConfigError, PluginError, UsageError
from s2r_runtime.hookspecs import Effect, Parameter
from s2r_runtime.models.bound import BoundModel
from s2r_runtime.models.composed import compose, resolve_source, takes, words
from s2r_runtime.modelspec import ModelSpec, load_model
from s2r_runtime.plugins import KINDS, registry, said

ANY_STEP_S = 1.0
"""A model file's step, which nothing that is told of it depends on."""


def plugin_show(args: argparse.Namespace) -> int:
    """Exit 0. Raises PluginError if nothing of that name is offered, ConfigError if a model's file is none."""
    if args.name.endswith((".py", ".toml")):
        if args.model:
            raise UsageError(f"--model {args.model}: belongs to an effect, {args.name} is a model")
        found = [_of_model(args.name)]
    else:
        kinds = [kind for kind in KINDS if args.name in registry().names(kind)]
        if not kinds:
            raise PluginError(_unknown(args.name))
        if args.model and kinds != ["effects"]:
            raise UsageError(
                f"--model {args.model}: belongs to an effect, {args.name} is offered as {' and '.join(_one(k) for k in kinds)}"
            )
        found = [_told(kind, args.name, args.model) for kind in kinds]
    if args.json:
        output.result_json({"offers": found})
    else:
        output.out_lines("\n\n".join("\n".join(_lines(one)) for one in found))
    return 0


def _unknown(name: str) -> str:
    known = sorted({one for kind in KINDS for one in registry().names(kind)})
    of = {word: one for one in known for word in one.split("_")} | {one: one for one in known}  # a word of it comes to mind first
    near = difflib.get_close_matches(name, of, 1, 0.6)
    return f"nothing of the name {name!r} is offered; " + (f"did you mean {of[near[0]]!r}?" if near else "s2r plugin list says what is")


def _one(kind: str) -> str:
    return kind[:-1]


def _told(kind: str, name: str, model: str | None) -> dict[str, Any]:
    if kind == "models":
        return _of_model(name)
    offered = registry().offered(kind, name)
    told: dict[str, Any] = {"kind": _one(kind), "name": name, "summary": offered.offer.summary, "distribution": offered.distribution}
    if kind == "effects":
        return told | _of_effect(name, model)
    thing = registry().get(kind, name)
    options = getattr(thing, "PARAMETERS", None) if kind == "tasks" else getattr(thing, "OPTIONS", None)
    if kind == "tasks" and options:
        told["options"] = [{"name": key, "default": default, "meaning": meaning} for key, (default, meaning) in options.items()]
    elif kind == "transports" and options:
        told["options"] = [{"name": key, "meaning": meaning} for key, meaning in options.items()]
    return told


def _bound(name: str) -> BoundModel:
    """A model as effects see it. Raises ConfigError."""
    spec = load_model(Path(name)) if name.endswith(".toml") else ModelSpec(name, ANY_STEP_S)
    return compose(resolve_source(spec, Path.cwd()), name).for_effects


def _of_model(name: str) -> dict[str, Any]:
    model = _bound(name)
    mine = name.endswith((".py", ".toml"))
    offered = None if mine else registry().offered("models", name)
    return {
        "kind": "model",
        "name": name,
        "summary": offered.offer.summary if offered else "",
        "distribution": offered.distribution if offered else "",
        "states": [{"name": s, "unit": model.units.get(s, "")} for s in model.states],
        "inputs": [{"name": u, "unit": model.units.get(u, "")} for u in model.inputs],
        "angles": list(model.angles),
        "parameters": [{"name": key, "value": value} for key, value in model.parameters.items()],
        "effects": [{"name": one, **entry} for one in registry().names("effects") for entry in _acting(one, model)],
    }


def _of_effect(name: str, model: str | None) -> dict[str, Any]:
    effect: Effect = registry().get("effects", name)
    on = [{"model": one, **entry} for one in ([model] if model else _bindable()) for entry in _acting(name, _bound(one))]
    if model and not on:
        raise ConfigError(f"effect {name!r} acts on nothing that the model {model} has")
    return {"stage": effect.stage, "parameters": [_number(effect, p) for p in effect.parameters], "on": on}


def _number(effect: Effect, p: Parameter) -> dict[str, Any]:
    """A parameter as JSON."""
    choices = getattr(effect, "choices", {}).get(p.name)
    told: dict[str, Any] = {"name": p.name, "optional": p.name in getattr(effect, "optional", ())}
    if choices or p.name in getattr(effect, "named", ()):
        return told | {"words": list(choices or ()), "input": not choices}
    return told | {"low": p.low, "high": p.high, "neutral": p.neutral, "shape": list(p.shape)}


def _bindable() -> Iterator[str]:
    """Models that can be used. What one of somebody else's raises is told, and is not the end."""
    for name in registry().names("models"):
        try:
            _bound(name)
        except Exception as error:  # noqa: BLE001 - as in `plugins`
            output.err(f"s2r: model {name!r} is left out: {said(error)}")
        else:
            yield name


def _acting(name: str, model: BoundModel) -> list[dict[str, Any]]:
    """As `_channels`. What an effect of somebody else raises is told, and is not the end."""
    try:
        return _channels(registry().get("effects", name), model)
    except Exception as error:  # noqa: BLE001 - as in `plugins`
        output.err(f"s2r: effect {name!r} is left out on {model.name}: {said(error)}")
        return []


def _channels(effect: Effect, model: BoundModel) -> list[dict[str, Any]]:
    """The channels of an effect on a model, those together on which its numbers have the same units."""
    found: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for channel in effect.channels(model):
        numbers = [name for name in takes(effect, model, channel) if words(effect, channel, model, name) is None]
        units = tuple((name, effect.unit(model, channel, name)) for name in numbers)
        found.setdefault(units, []).append(channel)
    return [{"channels": channels, "units": dict(units)} for units, channels in found.items()]


def _lines(told: dict[str, Any]) -> Iterator[str]:
    """The same for people."""
    yield f"{told['kind']} {told['name']}" + (f": {told['summary']}" if told["summary"] else "")
    if told["distribution"]:
        yield f"    from {told['distribution']}"
    if told["kind"] == "model":
        yield from _of_a_model(told)
    elif told["kind"] == "effect":
        yield f"    stage: {told['stage']}"
        if told["parameters"]:
            yield "    parameters:"
            yield from _table([(p["name"], _range(p)) for p in told["parameters"]])
        yield "    acts on:"
        rows = [(one["model"], ", ".join(one["channels"]), _units(one["units"])) for one in told["on"]]
        yield from _table(rows) if rows else ["      none of these models; --model FILE.py says on what of yours"]
    elif "options" in told:
        yield "    options:"
        defaults = [f"default {o['default']}" if "default" in o else "" for o in told["options"]]
        yield from _table(
            [(o["name"], *((d,) if any(defaults) else ()), o["meaning"]) for o, d in zip(told["options"], defaults, strict=True)]
        )


def _of_a_model(told: dict[str, Any]) -> Iterator[str]:
    for what in ("states", "inputs"):
        yield f"    {what}: " + ", ".join(f"{one['name']} ({one['unit'] or 'no unit said'})" for one in told[what])
    if told["angles"]:
        yield f"    angles: {', '.join(told['angles'])}"
    yield "    parameters: " + (", ".join(f"{one['name']} = {one['value']:g}" for one in told["parameters"]) or "none")
    yield "    effects that make sense on it:"
    yield from _table([(one["name"], ", ".join(one["channels"]), _units(one["units"])) for one in told["effects"]])


def _range(p: dict[str, Any]) -> str:
    if "words" in p:
        text = "the name of another input" if p["input"] else f"one of: {', '.join(p['words'])}"
    else:
        text = f"{p['low']:g} to {p['high']:g}" + ("" if p["neutral"] is None else f"; {p['neutral']:g} is none")
        text += f"; {p['shape'][0]} rows of {p['shape'][1]}" if p["shape"] else ""
    return text + ("; may be left out" if p["optional"] else "")


def _units(units: dict[str, str]) -> str:
    return ", ".join(f"{name} ({unit or '-'})" for name, unit in units.items())


def _table(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """In columns."""
    wide = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)] if rows else []
    for row in rows:
        yield "      " + "  ".join([*(f"{cell:{w}}" for cell, w in zip(row[:-1], wide, strict=True)), row[-1]]).rstrip()
