"""The user's DBC (or KCD, SYM, ARXML, CDD): read by cantools, looked up by name, with the nearest names where there is no such one.

Of a DBC cantools gets only the messages that the profile names (`dbc`), so that nothing else in it can refuse the file.
"""

from __future__ import annotations

import difflib
import logging
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_can.dbc import Outline
from s2r_can.options import checked, named
from s2r_can.records import key_of
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database import Database as CanDatabase
    from cantools.database.can import Message, Signal

FORMATS = {"dbc": "dbc", "kcd": "kcd", "sym": "sym", "arxml": "arxml", "cdd": "cdd"}


class Named(NamedTuple):
    """A signal and its message."""

    message: Message
    signal: Signal

    def __str__(self) -> str:
        return f"{self.message.name}.{self.signal.name}"


def looked_up(option: Any) -> tuple[dict[int, tuple[Database, Message]], dict[int, str]]:
    """(messages by key, why others cannot be used by key), of a whole file: a message that is wrong does not refuse the rest.

    Raises ConfigError for a file that cannot be read as a whole.
    """
    whole = Database(option, (set(), set()))  # of a DBC the outline alone
    refused = dict(whole.wrong)
    parts = [whole] if whole.messages else list(_halves(option, sorted({name for _, name in whole.keys} - set(refused)), refused))
    having = {message.name: database for database in parts for message in database.messages.values()}
    found, why = {}, {}
    for key, name in whole.keys:
        try:
            if name in having:
                found[key] = having[name], having[name].message(name, "DBC")
        except ConfigError as error:
            refused[name] = str(error)
        if name in refused:
            why[key] = refused[name]
    return found, why


def _halves(option: Any, names: list[str], refused: dict[str, str]) -> Iterator[Database]:
    """The messages of these names; what is wrong with those that cantools refuses goes into `refused`."""
    if not names:
        return
    try:
        yield Database(option, (set(names), set()))
    except ConfigError as error:
        if len(names) == 1:
            refused[names[0]] = str(error)
            return
        yield from _halves(option, names[: len(names) // 2], refused)
        yield from _halves(option, names[len(names) // 2 :], refused)


def stated(options: dict[str, Any], option: str) -> str:
    """What the DBC states of the messages that these options name (`Offer.normal_form`); of another format, all of its text.

    Raises ConfigError.
    """
    name, text = _text(options[option])
    if kind_of(name) != "dbc":
        return text
    cut = Outline(text).cut(*named(checked(options)))
    return "\n".join([cut.text, *(f"{alias} {given}" for alias, given in sorted(cut.names.items()))])


class Database:
    """option: what the user wrote for `transport.dbc`: a path, or the file as the profile holds it. names: of messages, and of signals
    without one, that are looked up (None: all). Raises ConfigError.

    messages: by name, as far as they were looked up. keys: (key, name) of all messages of the file. wrong: name of a message -> its first
    line that cannot be read.
    """

    def __init__(self, option: Any, names: tuple[set[str], set[str]] | None = None) -> None:
        self.name, text = _text(option)
        aliases: dict[str, str] = {}
        self._all: dict[str, list[str]] = {}
        keys: list[tuple[int, str]] = []
        self.wrong: dict[str, str] = {}
        self._branches: dict[int, set[str]] = {}
        if kind_of(self.name) == "dbc":
            outline = Outline(text)
            self._all = {message.called: message.names() for message in outline.messages}
            keys = [(message.number, message.called) for message in outline.messages]
            self.wrong = {message.called: message.wrong[0] for message in outline.messages if message.wrong}
            self._branches = {message.number: message.branches() for message in outline.messages}
            if not keys:
                raise ConfigError(f"transport.dbc: {self.name}: has no messages: no line of it begins one (BO_)")
            try:
                text, aliases = outline.cut(*(names or ({*self._all}, set())))
            except ConfigError as error:
                raise ConfigError(f"transport.dbc: {self.name}: {error}") from None
        messages = _parsed(self.name, text).messages if not keys or "\nBO_ " in text else []
        _renamed(messages, aliases)
        self.messages = {message.name: message for message in messages}
        if not keys:
            self._all = {message.name: [signal.name for signal in message.signals] for message in messages}
            keys = [(key_of(message.frame_id, extended=message.is_extended_frame), message.name) for message in messages]
        self.keys = keys
        self._twice = {name for name, count in Counter(name for _, name in keys).items() if count > 1}
        self._same: dict[int, list[str]] = {}
        for key, name in keys:
            self._same.setdefault(key, []).append(name)

    def message(self, name: object, where: str) -> Message:
        """The message of that name. Raises ConfigError."""
        found = self.messages.get(name) if isinstance(name, str) else None
        if found is None:
            raise ConfigError(f"{where}: {self.name} has no message {name!r}; {_nearest(str(name), list(self._all))}")
        same = self._same[key_of(found.frame_id, extended=found.is_extended_frame)]
        if name in self._twice or len(same) > 1:
            what = f"has several messages {name!r}" if name in self._twice else f"gives one identifier to {' and '.join(same)}"
            raise ConfigError(f"{where}: {self.name} {what}: leave the right one in it")
        if found.is_container:
            raise ConfigError(f"{where}: message {name!r} is a container, which cannot be read")
        return found

    def signal(self, name: object, where: str) -> Named:
        """The signal called `Message.Signal`, or `Signal` where only one message has one of that name. Raises ConfigError."""
        if not isinstance(name, str) or not name:
            raise ConfigError(f"{where} is {name!r}, must be a signal of {self.name}, as Message.Signal")
        first, dot, second = name.partition(".")
        if dot and first in self.messages:
            return self.signal_in(self.message(first, where), second, where)
        if not dot:
            having = [m for m in self.messages.values() if any(s.name == name for s in m.signals)]
            if len(having) == 1:
                return self.signal_in(self.message(having[0].name, where), name, where)
            if having:
                several = ", ".join(f"{m.name}.{name}" for m in having[:5])
                raise ConfigError(f"{where}: {len(having)} messages of {self.name} have a signal {name!r}: say which: {several}")
        known = [f"{message}.{signal}" for message, signals in self._all.items() for signal in signals]
        raise ConfigError(f"{where}: {self.name} has no signal {name!r}; {_nearest(name, known)}")

    def signal_in(self, message: Message, name: object, where: str) -> Named:
        """A signal of this message. Raises ConfigError."""
        found = next((s for s in message.signals if s.name == name), None)
        if found is None:
            nearest = _nearest(str(name), [s.name for s in message.signals])
            raise ConfigError(f"{where}: message {message.name} of {self.name} has no signal {name!r}; {nearest}")
        number = int(key_of(message.frame_id, extended=message.is_extended_frame))
        if found.name in self._branches.get(number, ()) and not found.multiplexer_ids:
            # cantools takes a signal that SG_MUL_VAL_ forgot for one that is always there
            raise ConfigError(
                f"{where}: {self.name} says that {message.name}.{name} is multiplexed, but not by what (SG_MUL_VAL_ lacks it)"
            )
        return Named(message, found)


def _text(option: Any) -> tuple[str, str]:
    if isinstance(option, dict) and {"file", "text"} <= set(option):
        return str(option["file"]), str(option["text"])
    if not isinstance(option, str) or not option:
        raise ConfigError(f"transport.dbc is {option!r}, must be the path of a DBC file")
    try:
        data = Path(option).read_bytes()
    except OSError as error:
        raise ConfigError(f"transport.dbc: {option}: cannot be read: {error.strerror}") from None
    try:
        return option, data.decode("utf-8-sig")
    except UnicodeDecodeError:  # older tools on Windows
        return option, data.decode("cp1252", "replace")


def kind_of(name: str) -> str:
    """The file's format, by its suffix."""
    return FORMATS.get(Path(name).suffix.lower().removeprefix("."), "dbc")


def _renamed(messages: list[Message], names: dict[str, str]) -> None:
    """Gives messages and signals the names that their file has. names: what cantools read -> the name."""
    for message in messages:
        message.name = names.get(message.name, message.name)
        for signal in message.signals:
            signal.name = names.get(signal.name, signal.name)
            if signal.multiplexer_signal is not None:
                signal.multiplexer_signal = names.get(signal.multiplexer_signal, signal.multiplexer_signal)


def _parsed(name: str, text: str) -> CanDatabase:
    import cantools

    logging.getLogger("cantools").setLevel(logging.CRITICAL)  # what it warns of is refused here, where it matters
    kind = kind_of(name)
    try:
        # what does not fit or overlaps is refused where it is used: files of others are rarely clean throughout
        found = cantools.database.load_string(text, database_format=kind, strict=False)
    except Exception as error:  # noqa: BLE001 - its parsers raise what they like at a file that is none
        said = " ".join(str(error).split())[:200]
        raise ConfigError(f"transport.dbc: {name}: cannot be read as {kind.upper()}: {said}") from None
    if not isinstance(found, cantools.database.Database):
        raise ConfigError(f"transport.dbc: {name}: holds diagnostics, not the messages of a bus")
    if not found.messages:
        raise ConfigError(f"transport.dbc: {name}: has no messages")
    return found


def _nearest(name: str, known: list[str]) -> str:
    """A hint for the reader, whatever he got wrong: letters, capitals, or only the message."""
    lower = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower(), list(lower), 3, 0.5)
    last = name.rpartition(".")[2].lower()
    same = [k for k in known if k.rpartition(".")[2].lower() == last and k.lower() not in near]
    found = [*same[:3], *(lower[n] for n in near)][:3]
    if found:
        return f"nearest: {', '.join(found)}"
    return f"there are: {', '.join(known[:8])}{', ...' if len(known) > 8 else ''}"
