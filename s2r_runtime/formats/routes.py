"""How a recording that is no table and no log of this software is read: by a transport's own reader, or by its named signals.

A bag or telemetry log with the profile of its robot is read by the transport's plug-in, which judges messages as on the wire. Everything
else is read by signals: those that the user names, the rest by usual names (`guess`), and what was taken for what is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from s2r_runtime.errors import MissingSignal, RecordingError, UsageError
from s2r_runtime.formats.guess import guessed
from s2r_runtime.formats.mapping import Recorded, read_signals, resolved, unit_notes
from s2r_runtime.formats.recognise import BAG, Form, not_installed, open_recording, recognised
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.robot_logs import is_robot_log, known_by_content, read_robot_log


def read_recording(
    path: Path,
    model: ComposedModel,
    *,
    columns: Mapping[str, str] | None = None,
    transport: Mapping[str, Any] | None = None,
    signals: Mapping[str, str] | None = None,
) -> Recorded | None:
    """The recording's stretches; None for a table, and for a log of this software.

    columns, signals: name in the model (or `t`, the stamps) -> signal; `columns` may be a profile's, and is not for bags. transport: the
    profile's. What was guessed is in the notes. Raises RecordingError, UsageError.
    """
    robots = is_robot_log(path)
    try:
        form = recognised(path)
    except RecordingError:
        if not robots or not known_by_content(path):
            raise
        form = None  # of a kind that is read by plug-ins only, such as a database of CAN frames
    if signals and form is None and robots:
        raise UsageError(f"{path}: --state and --input are for files with named signals; this log is read by its profile (--profile P)")
    if robots and not signals:
        try:
            log = read_robot_log(path, model, transport)
            return Recorded(log.stretches, notes=log.notes)
        except ImportError as error:
            if form is None:
                raise
            raise not_installed(path, form, error) from None
        except MissingSignal as error:
            if transport or form is None or form.name != BAG:
                raise
            return _by_guess(path, model, form, error)
    if form is None:
        return None
    known = {} if form.name == BAG else dict(columns or {})
    return _by_signals(path, model, form, known | dict(signals or {}))


def _by_guess(path: Path, model: ComposedModel, form: Form, error: MissingSignal) -> Recorded:
    """A bag without the usual topics. What it lacks of those is the better message where nothing can be guessed."""
    try:
        return _by_signals(path, model, form, {})
    except UsageError as other:
        if "pip install" in str(other):
            raise UsageError(f"{error}; to read others: {str(other).partition('; ')[2]}") from None
        raise UsageError(f"{error}. {str(other).removeprefix(f'{path}: ')}") from None


def _by_signals(path: Path, model: ComposedModel, form: Form, known: Mapping[str, str]) -> Recorded:
    opened = open_recording(path, form)
    signals = guessed(model, opened.topics(), known)
    found = resolved(path, model, signals, opened)
    notes = unit_notes(found)
    if taken := ", ".join(f"{name}={found[name].name}" for name in found if name not in known):
        notes.insert(0, f"{form.what}; taken by their names: {taken} (another one: --state NAME=SIGNAL, --input NAME=SIGNAL)")
    recorded = read_signals(path, model, signals, opened)
    return recorded._replace(notes=(*notes, *recorded.notes))
