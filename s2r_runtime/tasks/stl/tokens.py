"""The words of a formula, each with its column, counted from 1."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple, cast

from s2r_runtime.errors import ConfigError

WORDS = ("implies", "or", "and", "until", "not", "always", "eventually")
"""Words that no state and no name of a scenario can be meant by."""
_SAME = {"->": "implies", "||": "or", "|": "or", "&&": "and", "&": "and", "!": "not", "**": "^"}
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_][A-Za-z_0-9]*)"
    r"|(?P<sign>->|<=|>=|==|!=|&&|\|\||\*\*|[-+*/^()\[\],:<>!&|]))"
)


class Token(NamedTuple):
    """text: as it is meant: `&&` is `and`."""

    kind: Literal["number", "name", "sign", "word", "end"]
    text: str
    column: int

    @property
    def said(self) -> str:
        """For messages."""
        return "the end" if self.kind == "end" else repr(self.text)


def cut(text: str, where: str) -> list[Token]:
    """All of them, and the end. Raises ConfigError `where, column 5: ...` at a character that means nothing."""
    tokens, at = [], 0
    end = len(text.rstrip())
    while at < end:
        found = _TOKEN.match(text, at)
        if found is None:
            at += len(text[at:]) - len(text[at:].lstrip())
            raise ConfigError(f"{where}, column {at + 1}: {text[at]!r} means nothing in a formula")
        kind = cast("Literal['number', 'name', 'sign']", found.lastgroup)
        word = found.group(kind)
        word, column = _SAME.get(word, word), found.start(kind) + 1
        tokens.append(Token("word" if word in WORDS else kind, word, column))
        at = found.end()
    return [*tokens, Token("end", "", len(text.rstrip()) + 1)]
