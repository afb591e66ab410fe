"""Charts of figures per frame, with the frame that is shown marked on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import viser
from viser import uplot

from egopose.motion.rotations import Array

_PADDING = (12, 12, 0, 0)  # pixels, top first: numbers at the edge would be cut off
_WINDOW = 900  # frames a chart shows at most: 30 s; a longer clip's moves along


class Chart:
    """Lines over time. Lines of other names are another chart: :meth:`set` makes it anew.

    Args:
        gui: where it stands. title: above it.
    """

    def __init__(self, gui: viser.GuiApi, title: str) -> None:
        self._gui, self._title = gui, title
        self._handle: viser.GuiUplotHandle | None = None
        self._place = gui.add_folder(title)
        self._place.visible = False
        self._fps, self._begin, self._range = 30.0, 0.0, (0.0, 1.0)
        self._lines: list[Array] = []
        self._drawn: tuple[Any, ...] = ()

    def set(
        self,
        lines: Mapping[str, tuple[Array, str]],
        fps: float,
        band: tuple[str, str] | None = None,
        begin: float = 0.0,
        now: int = 0,
    ) -> None:
        """Show ``lines``: name -> (values ``[T]``, CSS colour).

        Args:
            lines: see above.
            fps: values a second.
            band: names of the high and the low edge.
            begin: s at the first value.
            now: the value to mark.
        """
        finite = {n: v for n, v in lines.items() if np.isfinite(v[0]).any()}
        if not finite:
            self._remove()
            return
        self._place.visible = True
        longest = max(len(v) for v, _ in finite.values())
        self._fps, self._begin = fps, begin
        self._lines = [np.pad(v, (0, longest - len(v)), constant_values=np.nan) for v, _ in finite.values()]
        series: list[Any] = [uplot.Series(label="s")]
        series += [uplot.Series(label=n, stroke=c, width=1.5, points={"show": False}) for n, (_, c) in finite.items()]
        series += [uplot.Series(label="now", stroke="#222", width=1, points={"show": False})]
        names = list(finite)
        drawn = (*((n, c) for n, (_, c) in finite.items()), band)
        low, high = (float(f([f(v[np.isfinite(v)]) for v in self._lines])) for f in (min, max))
        bottom, top = self._range
        kept = bottom <= low and high <= top and top - bottom <= 4 * ((high - low) or 1.0)
        if self._handle is not None and drawn == self._drawn and kept:
            # A browser needs a moment for a new chart or scale: lines that change all the time would never be seen.
            self.at(now)
            return
        margin = 0.05 * (high - low) or 1.0
        self._range = (low - margin, high + margin)
        scales: Any = {"x": {"time": False}, "y": {"auto": False, "range": self._range}}
        if self._handle is not None and drawn == self._drawn:
            self._handle.scales = scales
            self.at(now)
            return
        self._remove()
        self._place.visible, self._drawn = True, drawn
        bands = None
        if band is not None and set(band) <= set(names):
            edges = (1 + names.index(band[0]), 1 + names.index(band[1]))
            bands = (uplot.Band(series=edges, fill="rgba(70,110,220,0.2)"),)
        with self._place:
            self._handle = self._gui.add_uplot(
                self._data(now), tuple(series), scales=scales, bands=bands, aspect=2.6, padding=_PADDING
            )

    def _remove(self) -> None:
        self._place.visible = False
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def at(self, frame: int) -> None:
        """Mark a frame."""
        if self._handle is not None:
            self._handle.data = self._data(frame)

    def _data(self, frame: int) -> tuple[Array, ...]:
        total = len(self._lines[0])
        start = min(max(0, frame - _WINDOW // 2), max(0, total - _WINDOW))
        shown = slice(start, min(total, start + _WINDOW))
        # A spike from edge to edge; in the range of the chart the rest of it lies on the lower edge.
        now = np.full(shown.stop - start, self._range[0])
        if start <= frame < shown.stop:
            now[frame - start] = self._range[1]
        return (self._begin + np.arange(start, shown.stop) / self._fps, *(line[shown] for line in self._lines), now)
