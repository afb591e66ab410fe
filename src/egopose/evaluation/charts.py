"""Charts as inline SVG, drawn by matplotlib: lines over a common x, bars side by side.

Ink takes the page's colour, so that a chart is readable on light and on dark ground. matplotlib is imported where a
chart is drawn: it takes half a second.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

#: Told apart with any colour vision (Okabe & Ito 2008), on light and on dark ground.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7f7f7f")

_WIDTH, _HEIGHT = 760, 260  # points; the page scales them to its width
_NAMES = 60  # points more where names stand below the axis
_LONGEST = 24  # letters of such a name; the whole one is said where the pointer rests on the bar
_MOST_POINTS = 800
_INK = "#000000"  # text of this colour is written without one and so takes the page's; strokes are told to
_STYLE = {
    "svg.fonttype": "none",  # text as text: a fifth of its size as outlines, and found by the browser's search
    "text.parse_math": False,  # a dollar sign in a name is one
    "font.family": "sans-serif",
    "font.size": 12,
    "xtick.labelsize": 11,
    "ytick.labelsize": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#888888",
    "grid.alpha": 0.2,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
}


@dataclass(frozen=True)
class Line:
    """A curve: ``x [N]`` and ``y [N]``; where y is not finite the line is broken. ``band [2, N]``: its low and high."""

    label: str
    x: ArrayLike
    y: ArrayLike
    band: ArrayLike | None = None


@dataclass(frozen=True)
class Chart:
    """What a page shows: ``svg`` (markup, "" where there are no figures), ``colours`` by label, ``label`` of y."""

    svg: str
    colours: Mapping[str, str]
    label: str


def line_chart(
    lines: Sequence[Line], x_label: str, y_label: str, marks: ArrayLike = (), order: Sequence[str] | None = None
) -> Chart:
    """Curves with axes and ticks; y begins at zero or below.

    Args:
        lines: those without a finite point are not drawn.
        x_label, y_label: with units.
        marks: x of dashed vertical lines.
        order: labels in the order colours are given in, for charts of which some lack lines; the lines' by default.
    """
    colours = _colours([line.label for line in lines], order)
    if not any(np.isfinite(np.asarray(part, dtype=np.float64)).any() for line in lines for part in (line.y, line.band)):
        return Chart("", colours, y_label)
    with _drawing(_HEIGHT, y_label) as (figure, axes):
        titles = {}
        for k, line in enumerate(lines):
            step = -(-max(np.size(line.x), 1) // _MOST_POINTS)
            x, y = (np.asarray(v, dtype=np.float64)[::step] for v in (line.x, line.y))
            colour, name = colours[line.label], f"line-{k}"
            if line.band is not None:
                low, high = np.asarray(line.band, dtype=np.float64)[:, ::step]
                there = np.isfinite(low) & np.isfinite(high)
                around = (np.concatenate([v[there], w[there][::-1]]) for v, w in ((x, x), (low, high)))
                axes.fill(*around, color=colour, alpha=0.15, linewidth=0, gid=f"band-{k}", clip_on=False)
            axes.plot(x, y, color=colour, linewidth=1.6, gid=name, clip_on=False)
            titles[name] = line.label
        axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
        for k, x in enumerate(np.asarray(marks, dtype=np.float64)):
            axes.axvline(x, color="#888888", linewidth=1, linestyle=(0, (3, 3)), gid=f"mark-{k}", clip_on=False)
        axes.set_xlabel(_plain(x_label))
        axes.xaxis.set_major_formatter("{x:.6g}")
        return Chart(_svg(figure, titles), colours, y_label)


def bar_chart(
    groups: Sequence[str], bars: Mapping[str, ArrayLike], y_label: str, order: Sequence[str] | None = None
) -> Chart:
    """Bars, a group a name, a bar in each group for every series ``[groups]``; ``order`` as of lines."""
    colours = _colours(list(bars), order)
    width = 0.8 / max(len(bars), 1)
    with _drawing(_HEIGHT + _NAMES, y_label) as (figure, axes):
        titles = {}
        for k, (label, values) in enumerate(bars.items()):
            left = np.arange(len(groups)) - 0.4 + k * width
            heights = np.asarray(values, dtype=np.float64)
            drawn = axes.bar(left, heights, width, align="edge", color=colours[label], clip_on=False)
            for g, (bar, height) in enumerate(zip(drawn, heights, strict=True)):
                bar.set_gid(f"bar-{k}-{g}")
                bar.set_visible(bool(np.isfinite(height)))
                titles[f"bar-{k}-{g}"] = f"{groups[g]}, {label}: {height:.4g}"
        axes.set_xlim(-0.5, max(len(groups), 1) - 0.5)
        axes.set_ylim(bottom=0.0)
        axes.set_xticks(
            range(len(groups)), [_plain(g)[:_LONGEST] for g in groups], rotation=60, ha="right", rotation_mode="anchor"
        )
        return Chart(_svg(figure, titles), colours, y_label)


@contextmanager
def _drawing(height: float, y_label: str) -> Iterator[tuple[Any, Any]]:
    """A figure and its axes, with the style of all charts until it is written."""
    import matplotlib.style
    from matplotlib.figure import Figure

    # From the defaults: a matplotlibrc of the user does not reach a report.
    with matplotlib.style.context(["default", _STYLE]), warnings.catch_warnings():
        # Names in scripts that matplotlib's font lacks: the browser has its own.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font", category=UserWarning)
        figure = Figure(figsize=(_WIDTH / 72, height / 72), layout="constrained")
        axes = figure.add_subplot()
        axes.margins(x=0.0, y=0.06)
        axes.set_title(_plain(y_label))
        axes.yaxis.set_major_formatter("{x:.6g}")
        yield figure, axes


def _svg(figure: Any, titles: Mapping[str, str]) -> str:
    """The figure as an element for a page of HTML.

    Args:
        figure: of matplotlib.
        titles: what is said of a part, by the part's name, when the pointer rests on it.
    """
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True)
    root = ElementTree.fromstring(stream.getvalue())
    for part in list(root):
        if not part.tag.endswith("}g"):  # licence metadata, and a style sheet that would be the whole page's
            root.remove(part)
    for part in root.iter():
        part.tag = part.tag.rpartition("}")[2]  # HTML knows SVG without its namespace
        part.text = None if len(part) else part.text
        part.tail = None
        name = part.attrib.pop("id", "")  # several charts stand in one page
        if name in titles:
            part.insert(0, said := ElementTree.Element("title"))
            said.text = _plain(titles[name])
        if kind := re.fullmatch(r"(line|band|mark|bar)(-\d+)+", name):
            part.set("class", kind[1])
        part.attrib.pop("clip-path", None)  # by name as well; nothing lies outside the axes
        if "style" in part.attrib:
            style = re.sub(r"font-family: [^;]*;\s*", "", part.attrib["style"])  # the page's own
            part.set("style", style.replace(f"stroke: {_INK}", "stroke: currentColor"))
        if "d" in part.attrib:
            part.set("d", _rounded(part.attrib["d"]))
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img"}
    return ElementTree.tostring(root, encoding="unicode")


def _rounded(path: str) -> str:
    """To a tenth of a point, on one line: a third of the size."""
    return " ".join(re.sub(r"-?\d+\.\d+", lambda number: f"{float(number[0]):.1f}", path).split())


def _plain(text: str) -> str:
    """Without control characters, which XML cannot hold."""
    return "".join(c if c.isprintable() else "\ufffd" for c in str(text))


def _colours(labels: Sequence[str], order: Sequence[str] | None) -> dict[str, str]:
    """Label -> colour, by its place in ``order``; anew after eight."""
    places = list(labels if order is None else order)
    return {label: COLOURS[places.index(label) % len(COLOURS)] for label in labels}
