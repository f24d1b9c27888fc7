"""One self-contained HTML page: no script, no request to anywhere, readable on paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

from s2r_runtime.files.printable import printable_lines

_STYLE = resources.files("s2r_runtime.report").joinpath("page.css").read_text(encoding="utf-8")


SENTENCE = 25
"""Characters from which on a cell may be broken at its spaces."""


class Page:
    """Collects sections and renders them. Everything given as text is escaped; figures are SVG of our own."""

    def __init__(self, title: str, subtitle: str, *, wide: bool = False) -> None:
        self._title, self._wide = title, wide
        self._parts = [f"<h1>{escape(title)}</h1>", f'<p class="soft">{escape(subtitle)}</p>']

    def heading(self, text: str, level: int = 2) -> None:
        """A section's or subsection's title."""
        self._parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def text(self, text: str, kind: str = "") -> None:
        """A paragraph. kind: good, bad, warn, soft, statement, verdict; several apart by a space."""
        self._parts.append(f'<p class="{escape(kind)}">{escape(text)}</p>')

    def items(self, lines: Iterable[str], kind: str = "") -> None:
        """A numbered list."""
        self._parts.append(f'<ol class="{escape(kind)}">' + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ol>")

    def table(self, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """A table; numbers are set in equal width, and only what is as long as a sentence is broken into lines."""
        cells = "".join("<tr>" + "".join(_cell(str(c)) for c in row) + "</tr>" for row in rows)
        self._parts.append(f'<div class="scroll"><table><tr>{"".join(f"<th>{escape(h)}</th>" for h in head)}</tr>{cells}</table></div>')

    def folded(self, summary: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """A table that is shown when its summary is clicked."""
        self._parts.append(f"<details><summary>{escape(summary)}</summary>")
        self.table(head, rows)
        self._parts.append("</details>")

    def figure(self, svg: str, caption: str) -> None:
        """An SVG figure with its caption."""
        self._parts.append(f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>")

    def broad(self, svg: str, caption: str) -> None:
        """A figure as broad as the page; in a narrow window it scrolls."""
        self._parts.append(f'<figure><div class="broad">{svg}</div><figcaption>{escape(caption)}</figcaption></figure>')

    def panels(self, figures: Iterable[tuple[str, str]]) -> None:
        """Small figures (SVG, caption) side by side, as many as the window is wide enough for."""
        cells = "".join(f"<figure>{svg}{f'<figcaption>{escape(c)}</figcaption>' if c else ''}</figure>" for svg, c in figures)
        self._parts.append(f'<div class="panels">{cells}</div>')

    def key(self, entries: Iterable[tuple[str, str]]) -> None:
        """What the colours of the figures below mean: (words, name of a colour in the style sheet)."""
        told = "".join(f'<span><i style="background:var(--{escape(colour)})"></i>{escape(words)}</span>' for words, colour in entries)
        self._parts.append(f'<div class="key">{told}</div>')

    def bars(self, rows: Sequence[tuple[str, float, str, str]]) -> None:
        """(label, value, its text, name of a colour): bars from zero on one scale; a negative value has none."""
        most = max([value for _, value, _, _ in rows] + [1e-300])
        cells = "".join(
            f'<span>{escape(label)}</span><span class="soft">{escape(text)}</span>'
            f'<b style="width:{max(0.0, 100.0 * value / most):.1f}%;background:var(--{escape(colour)})"></b>'
            for label, value, text, colour in rows
        )
        self._parts.append(f'<div class="bars">{cells}</div>')

    def html(self) -> str:
        """The page."""
        head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(self._title)}</title>'
        kind = ' class="wide"' if self._wide else ""
        body = f"<body><main{kind}>{''.join(self._parts)}</main></body>"
        return printable_lines(f'<!doctype html><html lang="en"><head>{head}<style>{_STYLE}</style></head>{body}</html>\n')


def _cell(text: str) -> str:
    return f'<td class="n">{escape(text)}</td>' if len(text) < SENTENCE or " " not in text else f"<td>{escape(text)}</td>"
