"""A DBC file, cut down to the messages that a profile names, in a normal form: what cantools gets to read, and what a digest covers.

Other people's files are rarely clean throughout, and each version of cantools refuses other lines. A message that the profile never names
cannot refuse the file. Of the messages that it names, these statements count, and must be right:

    BO_  SG_  VAL_  SIG_VALTYPE_  SG_MUL_VAL_  BA_ (of the attributes in `ATTRIBUTES`), with BA_DEF_ and BA_DEF_DEF_

Left out: comments, nodes, statements about signals that do not exist. An identifier above 7FF without bit 31 can only be an extended
one. Names that cantools does not accept (they begin with a digit) get others for its eyes: `Cut.names`.

Normal form: messages by identifier, signals by name, values by number, one statement a line; numbers as Python writes floats.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import NamedTuple

from s2r_runtime.errors import ConfigError

DEFAULTS = ("GenMsgCycleTime", "GenSigStartValue", "VFrameFormat")
ATTRIBUTES = {
    "GenMsgCycleTime": 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;',
    "GenSigStartValue": 'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 0;',
    "VFrameFormat": "",
    "SystemMessageLongSymbol": 'BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;',
    "SystemSignalLongSymbol": 'BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;',
}
"""Those that mean something here, and how each is defined where a file uses it without a definition."""

EXTENDED, STANDARD_MAX, EXTENDED_MAX = 1 << 31, 0x7FF, 0x1FFFFFFF
_STRING = r'"(?:[^"\\\n]|\\.)*"'
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_KEYWORD = re.compile(r"\s*([A-Z][A-Z_]*)(?=[\s:])")
_BO = re.compile(r"\s*BO_\s+(\d{1,10})\s+([^\s:]+)\s*:\s*(\d{1,4})\b[ \t]*(?!SG_)\S*")
_SG = re.compile(
    r"\s*SG_\s+([^\s:]+)[ \t]*(M|m\d{1,6}M?)?[ \t]*:[ \t]*(\d{1,4})\|(\d{1,3})@([01])([+-])[ \t]*\(([^,()\n]+),([^,()\n]+)\)"
    rf"[ \t]*\[([^|\]\n]+)\|([^|\]\n]+)\][ \t]*({_STRING})[^\n]*?(?=\n|\Z|\sSG_\s|\sBO_\s)"
)
_VAL = re.compile(rf"\s*VAL_\s+(\d{{1,10}})\s+(\S+)((?:\s+-?\d{{1,20}}\s+{_STRING})*)\s*;")
_PAIR = re.compile(rf"(-?\d+)\s+({_STRING})")
_TYPE = re.compile(r"\s*SIG_VALTYPE_\s+(\d{1,10})\s+([^\s:]+)\s*:?\s*([0-3])\s*;")
_MUX = re.compile(r"\s*SG_MUL_VAL_\s+(\d{1,10})\s+(\S+)\s+([^\s,;]+)((?:[ \t,]*\d{1,10}\s*-\s*\d{1,10})+)\s*;")
_BA = re.compile(r'\s*BA_\s+"([^"\n]*)"([^";\n]*)("[^"]*")?\s*;')
_DEFINITION = re.compile(rf'\s*(BA_DEF_|BA_DEF_DEF_)\s+(?:(BO_|SG_)\s+)?"([^"\n]*)"((?:[^";\n]|{_STRING})*);')
_COMMENT = re.compile(r'\s*CM_\s+[^";\n]*(?:"[^"]*"|"(?:[^"\\]|\\.)*")\s*;')
_SPACE = re.compile(r"\s*")
_HEADER = re.compile(r"BO|_|:|\d")
"""A line that may have been the beginning of another message, or another statement."""
_ABOUT = re.compile(r'\s*(?:VAL_|SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d{1,10})\b|\s*BA_\s+"(\w+)"\s+(?:BO_|SG_)\s+(\d{1,10})\b')


class Signal(NamedTuple):
    """name, and the rest of its line in normal form."""

    name: str
    rest: str


class Statement(NamedTuple):
    """head number signal other rest; signal, other: names of signals, or empty."""

    head: str
    rest: str
    signal: str = ""
    other: str = ""


@dataclass
class Message:
    """number: the identifier, bit 31 set for an extended one. statements: others about it. wrong: lines that cannot be read."""

    number: int
    name: str
    length: int
    long_name: str = ""
    signals: list[Signal] = field(default_factory=list)
    long_names: dict[str, str] = field(default_factory=dict)
    statements: list[Statement] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    @property
    def called(self) -> str:
        """As a profile names it."""
        return self.long_name or self.name

    def names(self) -> list[str]:
        """Its signals, as a profile names them."""
        return [self.long_names.get(signal.name, signal.name) for signal in self.signals]

    def branches(self) -> set[str]:
        """Its signals that are there only if a multiplexer selects them."""
        return {self.long_names.get(signal.name, signal.name) for signal in self.signals if signal.rest.startswith("m")}


class Cut(NamedTuple):
    """text: the normal form. names: what stands in it for a name that cantools does not accept -> that name."""

    text: str
    names: dict[str, str]


class Outline:
    """All messages of a file, as far as they can be read."""

    def __init__(self, text: str) -> None:
        self.messages: list[Message] = []
        self._by_number: dict[int, Message] = {}
        self._definitions: dict[tuple[str, str], str] = {}
        self._late: list[Callable[[], None]] = []
        self._current: Message | None = None
        self._torn: Message | None = None
        self._line = 1
        self._read(text.replace("\r\n", "\n").replace("\r", "\n"))
        for statement in self._late:
            statement()

    def cut(self, messages: Collection[str], signals: Collection[str]) -> Cut:
        """The messages that are called one of `messages`, or have a signal that is called one of `signals`. Raises ConfigError for a line
        about them that cannot be read.
        """
        kept = [m for m in self.messages if {m.name, m.called} & set(messages) or set(signals) & {*m.names(), *(s.name for s in m.signals)}]
        for message in kept:
            if message.wrong:
                raise ConfigError(f"message {message.called}: {message.wrong[0]}")
        aliases: dict[str, str] = {}
        lines = [line for message in sorted(kept, key=lambda m: (m.number, m.name)) for line in _spelled(message, aliases)]
        said = sorted(_statement(message, one, aliases) for message in kept for one in message.statements)
        used = [name for name in ATTRIBUTES if any(line.startswith(f'BA_ "{name}"') for line in said)]
        given = [name for kind, name in self._definitions if kind == "BA_DEF_" and (name in used or name in DEFAULTS)]
        defined = [ATTRIBUTES[name] for name in used if name not in given and ATTRIBUTES[name]]
        defined += [line for (_, name), line in sorted(self._definitions.items()) if name in given]
        return Cut("\n".join(['VERSION ""', "BU_:", *lines, *defined, *said]) + "\n", {alias: name for name, alias in aliases.items()})

    # ------------------------------------------------------------------ statements

    def _read(self, text: str) -> None:
        at, statements = 0, {"BO_": self._message, "SG_": self._signal, "CM_": self._comment, "VAL_": self._values}
        statements |= {"SIG_VALTYPE_": self._type, "SG_MUL_VAL_": self._multiplexed, "BA_": self._attribute}
        statements |= {"BA_DEF_": self._definition, "BA_DEF_DEF_": self._definition}
        while (begin := _SPACE.match(text, at).end()) < len(text):  # type: ignore[union-attr]
            self._line += text.count("\n", at, begin)
            at = begin
            keyword = _KEYWORD.match(text, at)
            if keyword is not None and keyword[1] != "SG_":
                self._current, self._torn = None, (self._torn or self._current) if keyword[1] not in statements else None
            taken = statements[keyword[1]](text, at) if keyword and keyword[1] in statements else 0
            if taken <= at:
                start = keyword.start(1) if keyword else at
                line_end = text.find("\n", start)
                taken = len(text) if line_end < 0 else line_end + 1
                self._unreadable(text, at, start, taken)
            self._line += text.count("\n", at, taken)
            at = taken

    def _unreadable(self, text: str, at: int, start: int, end: int) -> None:
        """A line that is no statement. If it is about a message, that one cannot be used."""
        line = " ".join(text[start:end].split())
        where = f"line {self._line + text.count(chr(10), at, start)} cannot be read: {line[:80]!r}"
        if line.startswith("SG_ ") and self._current is not None:
            self._current.wrong.append(where)
        elif line.startswith("SG_ ") and self._torn is not None:
            self._torn.wrong.append(where)
        elif line:
            self._torn = None if _HEADER.search(line) else self._current or self._torn
            self._current = None
        if (about := _ABOUT.match(text, at)) and (about[1] or about[2] in ATTRIBUTES):
            self._late.append(lambda: self._blame(int(about[1] or about[3]), where))

    def _blame(self, number: int, where: str) -> None:
        if message := self._by_number.get(_identifier(number)):
            message.wrong.append(where)

    def _message(self, text: str, at: int) -> int:
        found = _BO.match(text, at)
        if found is None:
            return 0
        number = _identifier(int(found[1]))
        self._current = None
        if number & ~EXTENDED <= EXTENDED_MAX:  # else it is none on the bus (VECTOR__INDEPENDENT_SIG_MSG)
            self._current = Message(number, found[2], int(found[3]))
            self.messages.append(self._current)
            self._by_number.setdefault(number, self._current)
        return found.end()

    def _signal(self, text: str, at: int) -> int:
        found = _SG.match(text, at)
        if found is None:
            return 0
        name, mux, start, length, order, sign, *numbers, unit = found.groups()
        spelled = [_number(one) for one in numbers]
        if None in spelled:
            return 0
        scale, offset, low, high = spelled
        if self._torn is not None:
            self._torn.wrong.append(
                f"line {self._line + text.count(chr(10), at, found.start(1))} comes behind what is no statement: {name!r}"
            )
        if self._current is not None:
            rest = f"{mux or ''}: {int(start)}|{int(length)}@{order}{sign} ({scale},{offset}) [{low}|{high}] {unit} Vector__XXX"
            self._current.signals.append(Signal(name, rest))
        return found.end()

    def _comment(self, text: str, at: int) -> int:
        found = _COMMENT.match(text, at)
        return found.end() if found else 0

    def _values(self, text: str, at: int) -> int:
        found = _VAL.match(text, at)
        if found is None:
            return 0
        pairs = sorted(((int(number), name) for number, name in _PAIR.findall(found[3])), key=lambda pair: pair[0])
        values = " ".join(f"{number} {name}" for number, name in pairs)
        self._late.append(lambda: self._about(int(found[1]), Statement("VAL_", f"{values} ;", found[2])))
        return found.end()

    def _type(self, text: str, at: int) -> int:
        found = _TYPE.match(text, at)
        if found is None:
            return 0
        self._late.append(lambda: self._about(int(found[1]), Statement("SIG_VALTYPE_", f": {found[3]};", found[2])))
        return found.end()

    def _multiplexed(self, text: str, at: int) -> int:
        found = _MUX.match(text, at)
        if found is None:
            return 0
        ranges = ", ".join(f"{int(a)}-{int(b)}" for a, b in re.findall(r"(\d+)\s*-\s*(\d+)", found[4]))
        self._late.append(lambda: self._about(int(found[1]), Statement("SG_MUL_VAL_", f"{ranges};", found[2], found[3])))
        return found.end()

    def _attribute(self, text: str, at: int) -> int:
        found = _BA.match(text, at)
        if found is None:
            return 0
        words, name = found[2].split(), found[1]
        value = found[3] or (words.pop() if words else "")
        if name in ATTRIBUTES and len(words) >= 2 and words[1].isdecimal() and len(words[1]) <= 10:
            number, signal = int(words[1]), words[2] if words[0] == "SG_" and len(words) == 3 else ""
            self._late.append(lambda: self._attributed(name, number, signal, value))
        return found.end()

    def _attributed(self, name: str, number: int, signal: str, value: str) -> None:
        message = self._by_number.get(_identifier(number))
        if message is None:
            return
        if name == "SystemMessageLongSymbol":
            message.long_name = value.strip('"')
        elif name == "SystemSignalLongSymbol":
            message.long_names[signal] = value.strip('"')
        value = value if value.startswith('"') else _number(value) or value
        self._about(number, Statement(f'BA_ "{name}" {"SG_" if signal else "BO_"}', f"{value};", signal))

    def _definition(self, text: str, at: int) -> int:
        found = _DEFINITION.match(text, at)
        if found is None:
            return 0
        kind, about, name, rest = found.groups()
        if name in ATTRIBUTES:
            self._definitions.setdefault((kind, name), f'{kind} {about + " " if about else ""}"{name}" {" ".join(rest.split())};')
        return found.end()

    def _about(self, number: int, statement: Statement) -> None:
        """Takes a statement, if there are the message and its signals."""
        message = self._by_number.get(_identifier(number))
        if message is not None and {statement.signal, statement.other} - {""} <= {one.name for one in message.signals}:
            message.statements.append(statement)


def _identifier(number: int) -> int:
    return number | EXTENDED if STANDARD_MAX < number <= EXTENDED_MAX else number


def _number(text: str) -> str | None:
    try:
        value = float(text)
    except ValueError:
        return None
    if not math.isfinite(value):
        return None
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def _alias(name: str, aliases: dict[str, str]) -> str:
    """The name, or one that cantools accepts in its place."""
    return name if _NAME.fullmatch(name) else aliases.setdefault(name, f"s2r_alias_{len(aliases)}")


def _spelled(message: Message, aliases: dict[str, str]) -> list[str]:
    head = f"BO_ {message.number} {_alias(message.name, aliases)}: {message.length} Vector__XXX"
    return [head, *(f" SG_ {_alias(s.name, aliases)} {s.rest}" for s in sorted(message.signals, key=lambda s: s.name))]


def _statement(message: Message, statement: Statement, aliases: dict[str, str]) -> str:
    names = [_alias(name, aliases) for name in (statement.signal, statement.other) if name]
    return " ".join([statement.head, str(message.number), *names, statement.rest])
