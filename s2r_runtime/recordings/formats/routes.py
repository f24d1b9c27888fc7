"""How a recording that is no table and no log of this software is read: by a transport's own reader, or by its named signals.

A bag or telemetry log with the profile of its robot is read by the transport's plug-in, which judges messages as on the wire. Everything
else is read by signals: those that the user names, the rest by usual names (`guess`), and what was taken for what is said. So is a
telemetry or CAN log whose signals the user names, with a profile or without.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from s2r_runtime.errors import MissingSignal, RecordingError, UsageError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.recordings.formats.guess import guessed
from s2r_runtime.recordings.formats.mapping import Recorded, read_signals, resolved, unit_notes
from s2r_runtime.recordings.formats.recognise import BAG, Form, not_installed, open_recording, recognised
from s2r_runtime.recordings.robot_logs import is_robot_log, known_by_content, read_robot_log, readers_of
from s2r_runtime.recordings.tables import ArrayTable, Source

FILES = ("dbc",)
"""Options of transports that name a file which describes messages, and can be given without a profile."""


class Named(NamedTuple):
    """A file with named signals: what it is, and the options of its reader."""

    form: Form
    options: dict[str, Any]


def read_recording(
    path: Source,
    model: ComposedModel,
    *,
    columns: Mapping[str, str] | None = None,
    transport: Mapping[str, Any] | None = None,
    signals: Mapping[str, str] | None = None,
) -> Recorded | None:
    """The recording's stretches; None for a table (in a file or in memory), and for a log of this software.

    columns, signals: name in the model (or `t`, the stamps) -> signal; `columns` may be a profile's, and is not for bags. transport: the
    profile's, or only the file that describes the messages (`dbc`). What was guessed is in the notes. Raises RecordingError, UsageError.
    """
    if isinstance(path, ArrayTable):
        if transport and set(transport) <= {"name", *FILES}:
            raise UsageError(f"{path}: --dbc: is no log of a CAN bus")
        return None
    robots, form = is_robot_log(path), form_of(path)
    named = signals_of_log(path, transport) if robots and form is None else None
    described = bool(transport) and set(transport or {}) <= {"name", *FILES}
    if described and not (named and named.options):
        raise UsageError(f"{path}: --dbc: is no log of a CAN bus")
    if named is not None and (signals or described):
        return _by_signals(path, model, named, dict(signals or {}))
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
        except (RecordingError, UsageError) as error:
            if transport or named is None:
                raise
            raise type(error)(f"{error}; or name its signals: --state NAME=SIGNAL, --input NAME=SIGNAL (s2r topics {path})") from None
    if form is None:
        return None
    known = {} if form.name == BAG else dict(columns or {})
    return _by_signals(path, model, Named(form, {}), known | dict(signals or {}))


def form_of(path: Path) -> Form | None:
    """As `recognised`; None also for a kind that is read by plug-ins only, such as a database of CAN frames. Raises RecordingError."""
    try:
        return recognised(path)
    except RecordingError:
        if not is_robot_log(path) or not known_by_content(path):
            raise
        return None


def signals_of_log(path: Path, transport: Mapping[str, Any] | None = None) -> Named | None:
    """How a robot's own log is read by named signals: the offer of `s2r_formats` that has the name of its reader. None without one.

    transport: the profile's, or the file that describes the messages; of several readers its own counts.
    """
    offers = registry()
    readers = [name for name in readers_of(path) if name in offers.names("formats")]
    own = [name for name in readers if name.partition(".")[0] == (transport or {}).get("name")]
    if not (own or readers):
        return None
    offer = offers.offered("formats", (own or readers)[0]).offer
    options = {name: value for name, value in (transport or {}).items() if name in offer.files}
    return Named(Form(offer.name, f"a {offer.summary}", ""), options)


def _by_guess(path: Path, model: ComposedModel, form: Form, error: MissingSignal) -> Recorded:
    """A bag without the usual topics. What it lacks of those is the better message where nothing can be guessed."""
    try:
        return _by_signals(path, model, Named(form, {}), {})
    except UsageError as other:
        if "pip install" in str(other):
            raise UsageError(f"{error}; to read others: {str(other).partition('; ')[2]}") from None
        raise UsageError(f"{error}. {str(other).removeprefix(f'{path}: ')}") from None


def _by_signals(path: Path, model: ComposedModel, named: Named, known: Mapping[str, str]) -> Recorded:
    opened = open_recording(path, *named)
    signals = guessed(model, opened.topics(), known)
    found = resolved(path, model, signals, opened)
    notes = unit_notes(found)
    if taken := ", ".join(f"{name}={found[name].name}" for name in found if name not in known):
        notes.insert(0, f"{named.form.what}; taken by their names: {taken} (another one: --state NAME=SIGNAL, --input NAME=SIGNAL)")
    recorded = read_signals(path, model, signals, opened)
    return recorded._replace(notes=(*notes, *recorded.notes))
