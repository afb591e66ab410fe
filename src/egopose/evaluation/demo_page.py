"""The page of `make demo`: what pretrained weights make of a person they have not seen, in moving pictures and words.

Made from folders of evaluations, of estimates or of forecasts: figures are those of ``results.json``, pictures those
of the videos in them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from egopose.checkpoint.pretrained import PREFIX
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.forecast_page import read_windows
from egopose.evaluation.page import DAMAGED, Film, Number, Picture, Table, render
from egopose.evaluation.protocols import METRICS
from egopose.vision.video import Frame, read_frames

#: Metrics of :data:`METRICS` in plain words, a row each.
WORDS = {
    "mpjpe_root_aligned": "a joint is off its place, the hips laid upon each other (mm)",
    "root_drift": "the hips are off their place in the room (mm)",
    "foot_skate": "a foot slides while it stands (mm/s)",
    "ground_penetration": "a foot sinks into the floor (mm)",
    "contact_accuracy": "feet rightly said to stand or not to (% of frames)",
    "jitter": "the motion is jerky (m/s³)",
}
#: The estimate beside the state regressor that has no body, by the ratio of the two.
_BESIDE = {
    "mpjpe_root_aligned": "The simulated body's joints are {:.2f} times as far off as those of the regressor alone.",
    "foot_skate": "Its feet slide {:.2f} times as fast.",
}
_FALLS = "times the body was about to fall and was put back"


@dataclass(frozen=True)
class DemoPageSettings:
    """See ``demo.page`` of ``conf/experiment/demo.yaml``.

    Args:
        stills: moments in a filmstrip.
        size: pixels a panel.
        fps: frames/s of the moving pictures, at most those of the videos.
    """

    stills: int
    size: int
    fps: float

    def __post_init__(self) -> None:
        for name in ("stills", "size", "fps"):
            if not getattr(self, name) > 0:
                raise InputError("conf/experiment/demo.yaml", f"demo.page.{name}", "must be positive")


@dataclass(frozen=True, eq=False)
class Clip:
    """A video of panels beside each other: frames ``[size, panels * size, 3]`` (RGB), at ``fps``."""

    path: Path
    frames: Sequence[Frame]
    fps: float

    @property
    def seconds(self) -> float:
        return len(self.frames) / self.fps

    def film(self, settings: DemoPageSettings, caption: str) -> Film:
        """The moving picture, with every so many a frame that the rate of ``settings`` is met."""
        every = max(1, round(self.fps / settings.fps))
        shown = [_resized(frame, settings.size) for frame in self.frames[::every]]
        return Film(shown, self.fps / every, caption)

    def strip(self, panels: int, settings: DemoPageSettings, caption: str) -> Picture:
        """A filmstrip: a column a moment, the first ``panels`` below each other. ``caption`` gets the moments."""
        last = len(self.frames) - 1
        moments = [round(t) for t in np.linspace(0, last, min(settings.stills, last + 1))]
        columns = []
        for moment in moments:
            frame = _resized(self.frames[moment], settings.size)
            parts = [frame[:, k * settings.size : (k + 1) * settings.size] for k in range(panels)]
            columns.append(np.concatenate(parts, axis=0))
        times = ", ".join(f"{moment / self.fps:.1f}" for moment in moments)
        return Picture(np.concatenate(columns, axis=1), f"{caption} At {times} s.")


def write_demo_page(evaluations: Mapping[str, Path], settings: DemoPageSettings, out: Path) -> Path:
    """Write the page.

    Args:
        evaluations: folders of evaluations by the weights' names, within the page's folder.
        settings: how much is shown.
        out: the HTML file; its folder must exist.

    Raises:
        InputError: a folder holds no evaluation with a video, or a damaged one.
    """
    results = {name: read_json(folder / "results.json", "results") for name, folder in evaluations.items()}
    parts = []
    for name, folder in evaluations.items():
        make = _forecasts if "horizons_s" in results[name] else _estimates
        try:
            part = make(folder, results[name], settings)
        except DAMAGED as error:
            raise InputError(folder / "results.json", "figures", f"is damaged: {error!r}") from None
        video = part.pop("video").relative_to(out.parent).as_posix()
        parts.append({**part, "name": f"{PREFIX}{name}", "video": video, "folder": folder.name})
    rendered = any(result.get("rendered_video") for result in results.values())
    out.write_text(
        render(
            "demo.html",
            title="Somebody's motion from the video of a camera they wear",
            data=results,
            parts_shown=sorted(parts, key=lambda part: part["title"]),
            rendered=rendered,
        ),
        encoding="utf-8",
    )
    return out


def _estimates(folder: Path, results: Mapping[str, Any], settings: DemoPageSettings) -> dict[str, Any]:
    clip = _first_video(folder, "takes/*/side_by_side.mp4")
    methods = list(results["figures"])
    decimals = {metric.key: metric.decimals for metric in METRICS}
    rows: list[list[Any]] = []
    for key, words in WORDS.items():
        values = [results["figures"][method].get(key) for method in methods]
        cells = [Number(value and value["value"], decimals[key]) for value in values]
        rows.append([words, *cells, Number(results["reference"].get(key), decimals[key])])
    rows.append([_FALLS, *(Number(results["resets"][method], 0) for method in methods), ""])
    header = ["on average", "estimate", "regressor alone, no body", "truth"]
    ratios = results["ratios"][methods[0]]
    said = [words.format(ratios[key]["value"]) for key, words in _BESIDE.items() if ratios.get(key)]
    return {
        "title": "Estimate: what the body did",
        "video": clip.path,
        "film": clip.film(settings, f"{clip.path.parent.name}, {clip.seconds:.1f} s, again and again."),
        "strip": clip.strip(3, settings, "From above: the true body, the simulated body, the wearer's view."),
        "table": Table(header, rows),
        "note": " ".join(said),
    }


def _forecasts(folder: Path, results: Mapping[str, Any], settings: DemoPageSettings) -> dict[str, Any]:
    clip = _first_video(folder, "windows/*/futures.mp4")
    windows = read_windows(folder, list(results["figures"]))
    fps, told = windows[0].truth.fps, list(windows[0].told)
    errors = {m: np.mean([w.joint_errors(m).mean(axis=1) for w in windows], axis=0) for m in told}
    rows = [
        [f"{seconds:.2f} s", *(Number(float(errors[m][: round(seconds * fps)].mean()), 1) for m in told)]
        for seconds in results["horizons_s"]
        if round(seconds * fps) <= len(errors[told[0]])
    ]
    header = [f"{WORDS['mpjpe_root_aligned'].removesuffix(' (mm)')}, mean of the first", "forecast (mm)"]
    note = f"{len(windows)} forecasts of {len(windows[0].truth) / fps:.1f} s each; the pictures are of the first."
    if errors[told[-1]].any():  # the truth may stand still
        ratio = errors[told[0]].mean() / errors[told[-1]].mean()
        note += f" Their joints are {ratio:.2f} times as far off as those of {told[-1]}."
    return {
        "title": "Forecast: what the body does next",
        "video": clip.path,
        "film": clip.film(settings, "Solid: the forecast. Green: what came. Beside them: the last frame seen."),
        "strip": clip.strip(1, settings, "The forecast (solid) and what came (green)."),
        "table": Table([*header, *(f"{method} (mm)" for method in told[1:])], rows),
        "note": note,
    }


def _first_video(folder: Path, pattern: str) -> Clip:
    """The first video of an evaluation that fits ``pattern``.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    paths = sorted(folder.glob(pattern))
    if not paths:
        raise InputError(folder, pattern, "is missing: evaluate with video.takes=1")
    times, frames = zip(*read_frames(paths[0]), strict=True)
    fps = (len(times) - 1) / times[-1] if len(times) > 1 else 1.0
    return Clip(paths[0], frames, fps)


def _resized(frame: Frame, size: int) -> Frame:
    """Panels of ``size`` pixels."""
    width = size * round(frame.shape[1] / frame.shape[0])
    return np.asarray(cv2.resize(frame, (width, size), interpolation=cv2.INTER_AREA), dtype=np.uint8)
