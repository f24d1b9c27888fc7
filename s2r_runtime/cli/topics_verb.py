"""s2r topics: what a recording holds, and which of it a model's states and inputs may be."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_dbc, transport_of
from s2r_runtime.errors import ConfigError, RecordingError, UsageError

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
    from s2r_runtime.recordings.formats.guess import guessed
    from s2r_runtime.recordings.formats.signals import paths_of

    model = _model(args.model) if args.model else None
    kind, topics, notes = _listed(args.recording, transport_of(args, None))
    topics = sorted(topics, key=lambda topic: (not topic.fields or topic.n == 0, not _moves(topic), topic.name))
    taken = guessed(model, topics) if model else {}
    usable = [topic for topic in topics if topic.fields and topic.n]
    if args.json:
        rows = [
            {
                "name": topic.name,
                "type": topic.kind,
                "n": topic.n,
                "rate_hz": round(topic.rate, 6),
                "first_s": _number(topic.first_s),
                "last_s": _number(topic.last_s),
                "signals": {path: topic.fields.get(path, "rad") for path in paths_of(topic)},
                "note": topic.note,
            }
            for topic in topics
        ]
        output.result_json({"recording": str(args.recording), "kind": kind, "topics": rows, "guess": taken, "notes": notes})
    else:
        _print(args, kind, topics, usable, model, taken)
        for line in notes:
            output.err(line)
    return 0 if usable else 3


def _listed(path: Path, described: dict[str, Any] | None) -> tuple[str, Sequence[Topic], list[str]]:
    """What the file is, its topics, and what the user should know of how it was read. described: by which file. Raises UsageError,
    RecordingError.
    """
    from s2r_runtime.files.table_text import refuse_special
    from s2r_runtime.recordings.formats.recognise import open_recording
    from s2r_runtime.recordings.formats.routes import Named, form_of, signals_of_log
    from s2r_runtime.recordings.robot_logs import is_mcap, is_robot_log

    refuse_special(path)
    form = form_of(path)
    named = Named(form, {}) if form else None if is_mcap(path) else signals_of_log(path, described)
    if described and not (named and named.options):
        raise UsageError(f"{path}: --dbc: is no log of a CAN bus")
    if named is not None:
        opened = open_recording(path, *named)
        return opened.kind, opened.topics(), opened.notes
    if is_mcap(path):
        raise UsageError(
            f"{path}: is a log of this software, whose states and inputs have their names; s2r log info {path} says what it holds"
        )
    if is_robot_log(path):
        raise UsageError(f"{path}: is a robot's own log; its profile says what is in it: s2r trace {path} --profile P")
    return "table", [_table(path)], []


def _table(path: Path) -> Topic:
    """A CSV as one topic without a name."""
    import numpy as np

    from s2r_runtime.modelspec import SEGMENT, TIME
    from s2r_runtime.recordings.formats.series import Topic
    from s2r_runtime.recordings.tables import header_of, missing_columns, places_of, read_csv

    header = [name for name in header_of(path) if name and name != SEGMENT]
    if len(header) <= 1:
        raise RecordingError(f"{path}: is no table, and nothing else that is known here: {missing_columns([TIME], header)}")
    stamps = places_of(path, [TIME], {}).get(TIME)
    if stamps is None:
        return Topic("", "table", 0, math.nan, math.nan, dict.fromkeys(header, ""), f"no column t (the stamps): --column {TIME}=NAME")
    table = read_csv(path, [])
    fields = {name: "" for name in header if name != stamps.column}
    if table.segment is None:
        return Topic("", "table", len(table.t), float(table.t.min()), float(table.t.max()), fields)
    lasts = sum(float(np.ptp(table.t[table.segment == k])) for k in range(len(table.segments)))
    note = f"{len(table.segments)} runs, by {SEGMENT}"
    return Topic("", "table", len(table.t), float(table.t.min()), float(table.t.max()), fields, note, lasts)


def _model(name: str) -> ComposedModel:
    from s2r_runtime.models.composed import compose, resolve_source
    from s2r_runtime.modelspec import ModelSpec, load_model

    spec = load_model(Path(name)) if name.endswith(".toml") else ModelSpec(name, USUAL_DT)
    try:
        return compose(resolve_source(spec, Path.cwd()), "--model")
    except ConfigError as error:
        raise UsageError(str(error)) from None


def _moves(topic: Topic) -> bool:
    """Whether the topic's type says where a robot is, or what it is commanded."""
    from s2r_runtime.recordings.formats.guess import INPUTS, STATES

    return any(topic.kind == source.match or f"#{topic.name}" == source.match for source in (*STATES, *INPUTS))


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


def _number(value: float) -> Any:
    return value if math.isfinite(value) else None
