"""s2r topics: what a recording holds, and which of it a model's states and inputs may be."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_dbc
from s2r_runtime.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.recordings.formats.series import Topic

FIELDS_SHOWN = 12
USUAL_DT = 0.05


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("topics")
    verb.add_argument("recording", type=Path, metavar="FILE", help="a bag (file or folder), a flight log, a measurement file, a table, ...")
    verb.add_argument("--model", metavar="M", default="", help="say which signals would be taken for this model's states and inputs")
    add_dbc(verb)
    verb.add_argument("--all", action="store_true", help=f"all signals of each topic (else the first {FIELDS_SHOWN})")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if something can be used, 3 if nothing can."""
    from s2r_runtime.api.recordings import listed, ordered, topic_json, transport_of
    from s2r_runtime.recordings.formats.guess import guessed

    model = _model(args.model) if args.model else None
    kind, topics, notes = listed(args.recording, transport_of(args.dbc, None))
    topics = ordered(topics)
    taken = guessed(model, topics) if model else {}
    usable = [topic for topic in topics if topic.fields and topic.n]
    if args.json:
        rows = [topic_json(topic) for topic in topics]
        output.result_json({"recording": str(args.recording), "kind": kind, "topics": rows, "guess": taken, "notes": list(notes)})
    else:
        _print(args, kind, topics, usable, model, taken)
        for line in notes:
            output.err(line)
    return 0 if usable else 3


def _model(name: str) -> ComposedModel:
    from s2r_runtime.models.composed import compose, resolve_source
    from s2r_runtime.modelspec import ModelSpec, load_model

    spec = load_model(Path(name)) if name.endswith(".toml") else ModelSpec(name, USUAL_DT)
    try:
        return compose(resolve_source(spec, Path.cwd()), "--model")
    except ConfigError as error:
        raise UsageError(str(error)) from None


def _print(
    args: argparse.Namespace,
    kind: str,
    topics: Sequence[Topic],
    usable: Sequence[Topic],
    model: ComposedModel | None,
    taken: dict[str, str],
) -> None:
    from s2r_runtime.recordings.formats.signals import full_name, quaternions

    spans = [topic for topic in topics if math.isfinite(topic.first_s)]
    begin = min((topic.first_s for topic in spans), default=0.0)
    end = max((topic.last_s for topic in spans), default=0.0)
    output.out(f"{args.recording}: {kind}; {len(usable)} of {len(topics)} topics have signals; {end - begin:.6g} s")
    for topic in topics:
        rate = f"{topic.rate:.4g} Hz" if topic.rate else "-"
        span = f"{topic.first_s - begin:.3f} to {topic.last_s - begin:.3f} s" if math.isfinite(topic.first_s) else "-"
        about = "  ".join(filter(None, [topic.name or "(table)", topic.kind, f"n {topic.n}", rate, span]))
        output.out("")
        output.out(about + (f"  ({topic.note})" if topic.note else "" if topic.fields else "  (no number in it)"))
        turned = quaternions(topic.fields)
        names = [f"{full_name(topic.name, one)} (yaw, rad)" for one in turned]
        names += [full_name(topic.name, one) + (f" ({unit})" if unit else "") for one, unit in topic.fields.items()]
        shown = names if args.all else names[:FIELDS_SHOWN]
        for line in _wrapped([*shown, *([f"and {len(names) - len(shown)} more (--all)"] if len(shown) < len(names) else [])]):
            output.out(f"    {line}")
    if model:
        output.out("")
        options = [
            f"--{'state' if name in model.states else 'input'} {name}={taken[name]}"
            for name in (*model.states, *model.inputs)
            if name in taken
        ]
        lacks = [name for name in (*model.states, *model.inputs) if name not in taken]
        output.out(
            f"{args.model}: " + (" ".join(options) or "nothing by usual names") + (f"; not found: {', '.join(lacks)}" if lacks else "")
        )


def _wrapped(names: Sequence[str], width: int = 110) -> list[str]:
    lines: list[str] = []
    for name in names:
        if lines and len(lines[-1]) + len(name) + 2 <= width:
            lines[-1] += f", {name}"
        else:
            lines.append(name)
    return lines
