"""The frame that all HTML pages share: head and style, tables, pictures inside the file.

A page needs nothing but itself: pictures are PNG in base64, no script and no font is loaded.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

STYLE = (
    "body{font:15px system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse;font-size:13px}td,th{padding:.15rem .6rem;border-bottom:1px solid #ddd;"
    "text-align:left}img{max-width:100%}pre{background:#f6f6f6;padding:1rem;white-space:pre-wrap}"
)


def page(title: str, heading: str, *parts: str) -> str:
    """One page.

    Parameters
    ----------
    title, heading
        Plain text.
    parts
        HTML.
    """
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
        f"<style>{STYLE}</style><h1>{html.escape(heading)}</h1>{''.join(parts)}</html>\n"
    )


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of plain texts."""
    cells = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in head) + f"</tr>{cells}</table>"


def picture(figure: Any, words: str) -> str:
    """A matplotlib figure as an image inside the page; `words` say what it shows."""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    data = base64.b64encode(png.getvalue()).decode()
    return f"<img alt='{html.escape(words, quote=True)}' src='data:image/png;base64,{data}'>"
