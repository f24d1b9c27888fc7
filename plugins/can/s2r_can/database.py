"""The user's DBC (or KCD, SYM, ARXML, CDD): read by cantools, asked by name, with the nearest names where there is no such one."""

from __future__ import annotations

import difflib
import logging
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_can.records import key_of
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database import Database as CanDatabase
    from cantools.database.can import Message, Signal

FORMATS = {"dbc": "dbc", "kcd": "kcd", "sym": "sym", "arxml": "arxml", "cdd": "cdd"}
_MESSAGE = re.compile(r"^BO_[ \t]+(\d+)[ \t]+\w+[ \t]*:(.*?)(?=^BO_[ \t]|\Z)", re.MULTILINE | re.DOTALL)
_BRANCH = re.compile(r"^[ \t]*SG_[ \t]+(\w+)[ \t]+m\d+M?[ \t]*:", re.MULTILINE)


class Named(NamedTuple):
    """A signal and its message."""

    message: Message
    signal: Signal

    def __str__(self) -> str:
        return f"{self.message.name}.{self.signal.name}"


class Database:
    """option: what the user wrote for `transport.dbc`: a path, or the file as the profile holds it. Raises ConfigError."""

    def __init__(self, option: Any) -> None:
        self.name, text = _text(option)
        messages = _parsed(self.name, text).messages
        self._messages = {message.name: message for message in messages}
        self._twice = {name for name, count in Counter(message.name for message in messages).items() if count > 1}
        self._same: dict[int, list[str]] = {}
        for message in messages:
            self._same.setdefault(key_of(message.frame_id, extended=message.is_extended_frame), []).append(message.name)
        self._branches = {int(number): set(_BRANCH.findall(body)) for number, body in _MESSAGE.findall(text)}

    def message(self, name: object, where: str) -> Message:
        """The message of that name. Raises ConfigError."""
        found = self._messages.get(name) if isinstance(name, str) else None
        if found is None:
            raise ConfigError(f"{where}: {self.name} has no message {name!r}; {_nearest(str(name), list(self._messages))}")
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
        if dot and first in self._messages:
            return self.signal_in(self.message(first, where), second, where)
        if not dot:
            having = [m for m in self._messages.values() if any(s.name == name for s in m.signals)]
            if len(having) == 1:
                return self.signal_in(self.message(having[0].name, where), name, where)
            if having:
                several = ", ".join(f"{m.name}.{name}" for m in having[:5])
                raise ConfigError(f"{where}: {len(having)} messages of {self.name} have a signal {name!r}: say which: {several}")
        known = [f"{m.name}.{s.name}" for m in self._messages.values() for s in m.signals]
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
    if isinstance(option, dict) and set(option) == {"file", "text"}:
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


def _parsed(name: str, text: str) -> CanDatabase:
    import cantools

    logging.getLogger("cantools").setLevel(logging.CRITICAL)  # what it warns of is refused here, where it matters
    suffix = Path(name).suffix.lower().removeprefix(".")
    kind = FORMATS.get(suffix, "dbc")
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
