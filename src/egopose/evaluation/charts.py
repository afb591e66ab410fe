"""Charts as inline SVG: lines over a common x, bars side by side. Text and axes take the page's colour."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Told apart with any colour vision (Okabe & Ito 2008), on light and on dark ground.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7f7f7f")

_WIDTH, _HEIGHT = 760, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 12, 26, 40
_MOST_POINTS = 800


@dataclass(frozen=True)
class Line:
    """A curve: ``x [N]`` and ``y [N]``; where y is not finite the line is broken. ``band [2, N]``: its low and high."""

    label: str
    x: ArrayLike
    y: ArrayLike
    band: ArrayLike | None = None


def line_chart(
    lines: Sequence[Line], x_label: str, y_label: str, marks: ArrayLike = (), order: Sequence[str] | None = None
) -> str:
    """An SVG of curves with legend, axes and ticks.

    Args:
        lines: at least one with a finite point.
        x_label, y_label: with units.
        marks: x of dashed vertical lines.
        order: labels in the order colours are given in, for charts of which some lack lines; the lines' by default.
    """
    xs = [np.asarray(line.x, dtype=np.float64) for line in lines]
    ys = [np.asarray(line.y, dtype=np.float64) for line in lines]
    bands = [None if line.band is None else np.asarray(line.band, dtype=np.float64) for line in lines]
    drawn = [*ys, *(band.ravel() for band in bands if band is not None)]
    finite = np.concatenate([y[np.isfinite(y)] for y in drawn]) if drawn else np.empty(0)
    if not len(finite):
        return f"<p>{escape(y_label)}: no figures.</p>"
    every_x = np.concatenate(xs)
    x_low, x_high = _padded(float(every_x.min()), float(every_x.max()), grow=False)
    y_low, y_high = _padded(min(float(finite.min()), 0.0), float(finite.max()), grow=True)
    to_x = _Scale(x_low, x_high, _LEFT, _WIDTH - _RIGHT)
    to_y = _Scale(y_low, y_high, _HEIGHT - _BOTTOM, _TOP)
    parts = _axes(x_low, x_high, y_low, y_high, x_label, y_label)
    for x in np.asarray(marks, dtype=np.float64):
        parts.append(f'<path class="mark" d="M{to_x(x):.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
    labels = [line.label for line in lines]
    colours = _colours(labels, order)
    for line, x, y, band in zip(lines, xs, ys, bands, strict=True):
        colour = colours[line.label]
        step = -(-len(x) // _MOST_POINTS)
        if band is not None:
            area = _area(x[::step], band[:, ::step], to_x, to_y)
            parts.append(f'<path class="band" fill="{colour}" fill-opacity=".15" d="{area}"/>')
        path = _path(x[::step], y[::step], to_x, to_y)
        parts.append(f'<path class="line" stroke="{colour}" d="{path}"><title>{escape(line.label)}</title></path>')
    return _svg(parts, _HEIGHT) + _legend(colours)


def bar_chart(
    groups: Sequence[str], bars: Mapping[str, ArrayLike], y_label: str, order: Sequence[str] | None = None
) -> str:
    """An SVG of bars, a group a name, a bar in each group for every series ``[groups]``; ``order`` as of lines."""
    colours = _colours(list(bars), order)
    series = {label: np.asarray(values, dtype=np.float64) for label, values in bars.items()}
    height = _HEIGHT + 60  # names stand on end below the axis
    floor = height - _BOTTOM - 60
    top = max((float(np.nanmax(v)) for v in series.values() if np.isfinite(v).any()), default=0.0)
    low, high = _padded(0.0, top, grow=True)
    to_y = _Scale(low, high, floor, _TOP)
    parts = _y_axis(low, high, to_y, y_label)
    parts.append(f'<path class="axis" d="M{_LEFT} {floor}H{_WIDTH - _RIGHT}"/>')
    slot = (_WIDTH - _LEFT - _RIGHT) / max(len(groups), 1)
    width = 0.8 * slot / max(len(series), 1)
    for g, group in enumerate(groups):
        left = _LEFT + slot * g
        middle = left + slot / 2
        parts.append(
            f'<text class="tick" text-anchor="end" transform="translate({middle + 4:.1f} {floor + 8})'
            f' rotate(-60)">{escape(group)}</text>'
        )
        for k, (label, values) in enumerate(series.items()):
            if not np.isfinite(values[g]):
                continue
            y = to_y(values[g])
            said = escape(f"{group}, {label}: {values[g]:.4g}")
            parts.append(
                f'<rect x="{left + 0.1 * slot + k * width:.1f}" y="{y:.1f}" width="{width:.1f}"'
                f' height="{max(floor - y, 0):.1f}" fill="{colours[label]}"><title>{said}</title></rect>'
            )
    return _svg(parts, height) + _legend(colours)


def ticks(low: float, high: float, most: int = 6) -> NDArray[np.float64]:
    """Round numbers from ``low`` to ``high``: steps of 1, 2 or 5 times a power of ten, at most ``most`` + 1 of them."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    return np.asarray(
        step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1), dtype=np.float64
    )


def _padded(low: float, high: float, *, grow: bool) -> tuple[float, float]:
    if high - low < 1e-12 * max(abs(low), abs(high), 1.0):
        return low, low + 1.0
    return low, high + (0.06 * (high - low) if grow else 0.0)


class _Scale:
    """Linear from data to pixels."""

    def __init__(self, low: float, high: float, start: float, stop: float) -> None:
        self._low, self._start, self._per = low, start, (stop - start) / (high - low)

    def __call__(self, value: float) -> float:
        return self._start + (value - self._low) * self._per


def _axes(x_low: float, x_high: float, y_low: float, y_high: float, x_label: str, y_label: str) -> list[str]:
    floor = _HEIGHT - _BOTTOM
    to_x = _Scale(x_low, x_high, _LEFT, _WIDTH - _RIGHT)
    parts = _y_axis(y_low, y_high, _Scale(y_low, y_high, floor, _TOP), y_label)
    parts.append(f'<path class="axis" d="M{_LEFT} {floor}H{_WIDTH - _RIGHT}"/>')
    for value in ticks(x_low, x_high, 8):
        parts.append(
            f'<text class="tick" text-anchor="middle" x="{to_x(value):.1f}" y="{floor + 16}">{value:.6g}</text>'
        )
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text text-anchor="middle" x="{middle}" y="{_HEIGHT - 6}">{escape(x_label)}</text>')
    return parts


def _y_axis(low: float, high: float, to_y: _Scale, label: str) -> list[str]:
    parts = [f'<text x="4" y="14">{escape(label)}</text>']
    for value in ticks(low, high, 5):
        y = to_y(value)
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="tick" text-anchor="end" x="{_LEFT - 6}" y="{y + 4:.1f}">{value:.6g}</text>')
    return parts


def _path(x: NDArray[np.float64], y: NDArray[np.float64], to_x: _Scale, to_y: _Scale) -> str:
    out, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if not math.isfinite(b):
            pen = "M"
            continue
        out.append(f"{pen}{to_x(a):.1f} {to_y(b):.1f}")
        pen = "L"
    return "".join(out)


def _area(x: NDArray[np.float64], band: NDArray[np.float64], to_x: _Scale, to_y: _Scale) -> str:
    """The ground between two curves, where both are finite."""
    there = np.isfinite(band).all(axis=0)
    low, high = (_path(x[there], edge[there], to_x, to_y) for edge in band)
    back = "L".join(reversed(high.removeprefix("M").split("L")))
    return f"{low}L{back}Z" if there.any() else ""


def _svg(parts: Sequence[str], height: int) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {height}" role="img">{"".join(parts)}</svg>'


def _colours(labels: Sequence[str], order: Sequence[str] | None) -> dict[str, str]:
    """Label -> colour, by its place in ``order``; anew after eight."""
    places = list(labels if order is None else order)
    return {label: COLOURS[places.index(label) % len(COLOURS)] for label in labels}


def _legend(colours: Mapping[str, str]) -> str:
    keys = (f'<span><i style="background:{colour}"></i>{escape(label)}</span>' for label, colour in colours.items())
    return f'<p class="legend">{"".join(keys)}</p>'
