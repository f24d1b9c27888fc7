"""One self-contained HTML page: no script, no request to anywhere, readable on paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

_STYLE = resources.files("s2r_runtime").joinpath("data/page.css").read_text(encoding="utf-8")


class Page:
    """Collects sections and renders them. Everything given as text is escaped; figures are SVG of our own."""

    def __init__(self, title: str, subtitle: str) -> None:
        self._title = title
        self._parts = [f"<h1>{escape(title)}</h1>", f'<p class="soft">{escape(subtitle)}</p>']

    def heading(self, text: str, level: int = 2) -> None:
        """A section's or subsection's title."""
        self._parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def text(self, text: str, kind: str = "") -> None:
        """A paragraph. kind: good, bad, warn, soft, statement."""
        self._parts.append(f'<p class="{escape(kind)}">{escape(text)}</p>')

    def items(self, lines: Iterable[str], kind: str = "") -> None:
        """A numbered list."""
        self._parts.append(f'<ol class="{escape(kind)}">' + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ol>")

    def table(self, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """A table; numbers are set in equal width."""
        cells = "".join("<tr>" + "".join(f'<td class="n">{escape(str(c))}</td>' for c in row) + "</tr>" for row in rows)
        self._parts.append(f"<table><tr>{''.join(f'<th>{escape(h)}</th>' for h in head)}</tr>{cells}</table>")

    def figure(self, svg: str, caption: str) -> None:
        """An SVG figure with its caption."""
        self._parts.append(f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>")

    def html(self) -> str:
        """The page."""
        head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(self._title)}</title>'
        body = "".join(self._parts)
        return f'<!doctype html><html lang="en"><head>{head}<style>{_STYLE}</style></head><body><main>{body}</main></body></html>\n'
