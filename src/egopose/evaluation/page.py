"""Self-contained HTML pages from the templates beside this file: nothing comes from elsewhere, and no script runs."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import jinja2

from egopose.evaluation.protocols import Metric
from egopose.vision.video import Frame

#: What reading a damaged results.json into a page raises.
DAMAGED = (KeyError, TypeError, AttributeError, IndexError, jinja2.UndefinedError)
_WEBP_QUALITY = 70  # percent: joints stay sharp; at 50 the film is a fifth smaller


@dataclass(frozen=True)
class Number:
    """A cell of a table: a figure and its interval. ``data-value`` of the page's cell holds it in full."""

    value: float | None
    decimals: int = 3
    interval: tuple[float, float] | None = None

    @property
    def known(self) -> bool:
        return self.value is not None and math.isfinite(self.value)

    def said(self, value: float) -> str:
        return f"{value:.{self.decimals}f}"


@dataclass(frozen=True)
class Table:
    """Rows of cells, each a :class:`Number` or plain text, under a header of plain text."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True)
class Picture:
    """A picture ``[H, W, 3]`` (RGB) and what is said of it."""

    frame: Frame
    caption: str

    @property
    def png(self) -> str:
        """As base64."""
        made, png = cv2.imencode(".png", cv2.cvtColor(self.frame, cv2.COLOR_RGB2BGR))
        if not made:
            raise RuntimeError("OpenCV made no PNG")
        return base64.b64encode(png.tobytes()).decode()


@dataclass(frozen=True)
class Film:
    """A moving picture without end: frames ``[H, W, 3]`` (RGB) of one size, ``fps`` of them a second.

    It is an image, not a video: browsers play animated WebP, but not the codec of the MP4 files.
    """

    frames: Sequence[Frame]
    fps: float
    caption: str

    @property
    def webp(self) -> str:
        """As base64."""
        film = cv2.Animation()
        film.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in self.frames]
        film.durations = [round(1e3 / self.fps)] * len(self.frames)
        made, webp = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
        if not made:
            raise RuntimeError("OpenCV made no WebP")
        return base64.b64encode(webp.tobytes()).decode()


def render(template: str, **values: Any) -> str:
    """The page of a template.

    Args:
        template: its name.
        values: what it shows. All text is escaped; ``data``, JSON-like, goes along under the id ``data`` for programs
            that read the page.
    """
    return _templates().get_template(template).render(values)


def result_cell(found: Mapping[str, Any] | None, decimals: int) -> Number:
    """Of a figure of ``results.json``: ``{value, low, high}``, the ends None where there is no interval."""
    if not found:
        return Number(None)
    between = None if found.get("low") is None else (found["low"], found["high"])
    return Number(found["value"], decimals, between)


def labelled(metric: Metric) -> str:
    """The metric's label with its unit, where it has one."""
    return f"{metric.label} ({metric.unit})" if metric.unit else metric.label


@cache
def _templates() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("egopose.evaluation"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    environment.tests["number"] = lambda cell: isinstance(cell, Number)
    return environment
