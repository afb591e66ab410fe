"""The parts of a self-contained HTML page: nothing in it comes from elsewhere, and no script runs."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import cv2

from egopose.vision.video import Frame

#: The browser itself is told to fetch nothing.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.2rem;margin-top:2.2rem}h3{font-size:1rem}
table{border-collapse:collapse;display:block;overflow-x:auto}
th,td{padding:.15rem .7rem;border-bottom:1px solid #8884;text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
td small{color:#888}
pre{background:#8881;padding:.6rem;overflow-x:auto;white-space:pre-wrap}
svg{width:100%;height:auto;font-size:12px;fill:currentColor}
svg .tick{font-size:11px}svg .axis{stroke:currentColor}svg .grid{stroke:#8883}
svg .mark{stroke:#888;stroke-dasharray:3 3}svg .line{fill:none;stroke-width:1.6}
.legend span{margin-right:1.2rem}.legend i{display:inline-block;width:.8rem;height:.8rem;margin-right:.35rem}
.moments{display:flex;flex-wrap:wrap;gap:1rem}.moments figure{margin:0}.moments img{max-width:100%}
figcaption{font-size:.85rem}
.note{color:#888}
"""


def page(title: str, sections: Sequence[tuple[str, str]], data: Mapping[str, Any]) -> str:
    """The whole document.

    Args:
        title: plain text.
        sections: heading (plain text) and content (HTML).
        data: JSON-like values that go along, under the id ``data``, for programs that read the page.
    """
    body = "".join(f"<section><h2>{escape(heading)}</h2>{content}</section>\n" for heading, content in sections)
    # "</" would end the element; JSON knows the same slash escaped.
    held = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>{escape(title)}</h1>\n{body}"
        f'<script type="application/json" id="data">{held}</script></body></html>\n'
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML (see :func:`number`, :func:`text`); the header is plain text."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def text(value: object) -> str:
    """A cell of plain text."""
    return f"<td>{escape(str(value))}</td>"


def number(value: float | None, decimals: int = 3, interval: tuple[float, float] | None = None) -> str:
    """A cell of a figure with its interval; ``data-value`` holds it in full."""
    if value is None or not math.isfinite(value):
        return "<td>-</td>"
    said = f"{value:.{decimals}f}"
    if interval is not None:
        said += f" <small>[{interval[0]:.{decimals}f}, {interval[1]:.{decimals}f}]</small>"
    return f'<td data-value="{value!r}">{said}</td>'


def picture(frame: Frame, caption: str) -> str:
    """A figure whose picture ``[H, W, 3]`` (RGB) stands in the page as PNG."""
    made, png = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    if not made:
        raise RuntimeError("OpenCV made no PNG")
    source = base64.b64encode(png.tobytes()).decode()
    said = escape(caption)
    return f'<figure><img alt="{said}" src="data:image/png;base64,{source}"><figcaption>{said}</figcaption></figure>'
