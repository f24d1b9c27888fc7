"""Named signals -> a recording's states and inputs, each on the stamps on which it came. `s2r gap` and `s2r trace` read through this.

A state of a message that its sender stamped counts from that stamp; an input, which acts when it arrives, from when it was recorded,
brought to the clock of the states' stamps (`clock`). An input holds until its next value. NaN, infinity and what is beyond `LARGEST` are
missing values. Stamps out of order are sorted, of two values of a signal on one stamp the later one counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import TIME
from s2r_runtime.recordings.formats.clock import newer, on_stamps, stretches
from s2r_runtime.recordings.formats.recognise import open_recording
from s2r_runtime.recordings.formats.series import Array, Opened, Run, Samples
from s2r_runtime.recordings.formats.signals import Signal, resolve
from s2r_runtime.recordings.robot_logs import Rows, Stretch
from s2r_runtime.recordings.tables import LARGEST
from s2r_runtime.recordings.units import factor_of

UNITY = 1e-12


class Recorded(NamedTuple):
    """stretches: of driving; called: their names, or (). drawn: they are samples of a campaign, as segments of a table are. notes: what a
    person should know of how they were read, one line each.
    """

    stretches: list[Stretch]
    called: tuple[str, ...] = ()
    drawn: bool = False
    notes: tuple[str, ...] = ()


def read_signals(path: Path, model: ComposedModel, signals: Mapping[str, str], opened: Opened | None = None) -> Recorded:
    """The recording, by what each state and input is. signals: name in the model (or `t`, the stamps) -> signal; states that the
    model can do without may lack.

    Raises RecordingError (unreadable, no value), UsageError (no such signal).
    """
    opened = opened or open_recording(path)
    found = resolved(path, model, signals, opened)
    wanted: dict[str, list[str]] = {}
    for signal in found.values():
        fields = wanted.setdefault(signal.topic, [])
        fields += [one for one in signal.fields if one not in fields]
    time = resolve(signals[TIME], list(opened.topics()), f"{path}: t={signals[TIME]}") if TIME in signals and TIME not in found else None
    if time is not None:
        wanted.setdefault(time.topic, []).extend(one for one in time.fields if one not in wanted.get(time.topic, []))
    parts, called = [], []
    for given in opened.read(wanted):
        run = given if time is None else _stamped(given, time)
        for stretch in _stretches(run, model, found):
            parts.append(stretch)
            called.append(run.name)
    for names, kind in ((model.states, 0), (model.inputs, 1)):
        for column, name in enumerate(names):
            if name in found and not any(np.isfinite(part[kind].values[:, column]).any() for part in parts):
                raise RecordingError(f"{path}: {found[name].name} holds no number ({name})")
    return Recorded(parts, tuple(called) if any(called) else (), opened.drawn, tuple(opened.notes))


def _stamped(run: Run, time: Signal) -> Run:
    """The run with a signal of its own in the place of its stamps."""
    samples = run.samples.get(time.topic)
    if samples is None:
        return run
    return replace(run, samples={**run.samples, time.topic: Samples(time.values(samples.values), samples.values)})


def resolved(path: Path, model: ComposedModel, signals: Mapping[str, str], opened: Opened) -> dict[str, Signal]:
    """Name in the model -> signal. Raises UsageError."""
    topics = list(opened.topics())
    found = {}
    for name in (*model.states, *model.inputs):
        if name in signals:
            option = "--state" if name in model.states else "--input"
            found[name] = resolve(signals[name], topics, f"{path}: {option} {name}={signals[name]}")
    free = getattr(model.nominal, "follows", {})
    if lacks := [name for name in (*model.states, *model.inputs) if name not in found and name not in free]:
        option = " ".join(f"--{'state' if name in model.states else 'input'} {name}=SIGNAL" for name in lacks)
        raise UsageError(f"{path}: which signals are {', '.join(lacks)}? Give {option}; s2r topics {path} lists what there is")
    return found


def unit_notes(found: Mapping[str, Signal]) -> list[str]:
    """What is brought to SI, and what is not since its unit is not known, in words."""
    notes = []
    for name, signal in found.items():
        if len(signal.fields) > 1 or not signal.unit:
            continue
        if factor_of(signal.unit) is None:
            notes.append(
                f"{name}: the unit of {signal.name}, {signal.unit}, is not known here; its numbers are taken as SI ({name}=SIGNAL*FACTOR)"
            )
        elif abs(signal.factor - 1.0) > UNITY:
            notes.append(f"{name}: {signal.name} is in {signal.unit}, taken times {signal.factor:.6g}")
    return notes


def _stretches(run: Run, model: ComposedModel, found: Mapping[str, Signal]) -> list[Stretch]:
    states = {name: found[name] for name in model.states if name in found}
    inputs = {name: found[name] for name in model.inputs}
    lead = next((run.samples[s.topic] for s in states.values() if s.topic in run.samples and run.samples[s.topic].stamps is not None), None)
    if lead is None or lead.stamps is None or not len(lead.t):
        return [Stretch(_rows(run, model.states, states, None), _rows(run, model.inputs, inputs, None))]
    origin = lead.t[0]
    parts = []
    for part in stretches(lead.t - origin, lead.stamps - origin):
        clock = _Clock(lead.t[part.rows], lead.stamps[part.rows], part.since + origin, part.until + origin)
        parts.append(Stretch(_rows(run, model.states, states, clock), _rows(run, model.inputs, inputs, clock, commands=True)))
    return parts


class _Clock(NamedTuple):
    """Rows of a stretch of the topic whose stamps lead, and from when to when it was recorded."""

    recorded: Array
    stamps: Array
    since: float
    until: float

    def taken(self, samples: Samples, *, commands: bool) -> tuple[NDArray[np.intp], Array]:
        """(which of the samples, their times on the clock of the stamps)."""
        chosen = np.flatnonzero((samples.t >= self.since) & (samples.t < self.until))
        if samples.stamps is not None and not commands:
            chosen = chosen[newer(samples.stamps[chosen])]
            return chosen, samples.stamps[chosen]
        return chosen, np.asarray(np.maximum.accumulate(on_stamps(self.recorded, self.stamps, samples.t[chosen])))


def _rows(run: Run, names: Sequence[str], signals: Mapping[str, Signal], clock: _Clock | None, *, commands: bool = False) -> Rows:
    """Signals on the stamps of all their topics, NaN where one did not come. Signals of one topic share its rows."""
    parts: list[tuple[Array, Array]] = []
    for topic in dict.fromkeys(signal.topic for signal in signals.values()):
        samples = run.samples.get(topic)
        if samples is None:
            continue
        chosen, t = (np.arange(len(samples.t)), samples.t) if clock is None else clock.taken(samples, commands=commands)
        values = np.full((len(t), len(names)), np.nan)
        for column, name in enumerate(names):
            if name in signals and signals[name].topic == topic:
                values[:, column] = signals[name].values(samples.values)[chosen]
        with np.errstate(invalid="ignore"):
            values[~(np.abs(values) <= LARGEST)] = np.nan
        kept = np.isfinite(t) & ~np.isnan(values).all(axis=1)
        parts.append((np.asarray(t)[kept], values[kept]))
    return _merged(parts, len(names))


def _merged(parts: Sequence[tuple[Array, Array]], width: int) -> Rows:
    t = np.concatenate([np.empty(0), *(part[0] for part in parts)])
    values = np.concatenate([np.empty((0, width)), *(part[1] for part in parts)])
    order = np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    stamps, first = np.unique(t, return_index=True)
    if len(stamps) == len(t):
        return Rows(t, values)
    made = values[first].copy()
    row = np.searchsorted(stamps, t)
    later = np.ones(len(t), dtype=bool)
    later[first] = False
    for k in np.flatnonzero(later).tolist():  # few: stamps that several rows share
        made[row[k]] = np.where(np.isnan(values[k]), made[row[k]], values[k])
    return Rows(stamps, made)
