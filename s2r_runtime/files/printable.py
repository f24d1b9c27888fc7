"""Text of files and peers, as a person may see it: the one function behind every door to a terminal, a journal or a page.

A name in a file can hold control sequences that move the cursor, set a clipboard, hide what was printed or turn it around. So every
character that is not printable (controls C0 and C1, format characters such as bidi overrides, surrogates, unassigned ones) becomes the
escape that Python would write for it, as in `\\x1b`. What is printable stays.
"""

from __future__ import annotations


def printable(text: str) -> str:
    """On one line: a line end is an escape, too."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable_lines(text: str) -> str:
    """As `printable`, of a text of several lines."""
    return "\n".join(map(printable, text.split("\n")))
