"""The viewer: scene, controls and charts around one timeline. All who look at it share what is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from egopose.viewer.auth_proxy import Address
from egopose.viewer.charts import Chart
from egopose.viewer.clip import Clip, Footage, Run
from egopose.viewer.figure import Color, Figure
from egopose.viewer.serving import furnish, tile
from egopose.viewer.sync_panel import SyncPanel
from egopose.viewer.timeline import TimelineViewer
from egopose.viewer.video_panel import Pictures

_MAIN: Color = (70, 110, 220)
_OTHER: Color = (235, 140, 40)
_REFERENCE: Color = (60, 190, 90)
_DRAWN: Color = (170, 80, 200)
_STEPS = ((12, 0.4), (24, 0.26), (45, 0.15))  # frames ahead and opacity: a forecast's poses to come
_NONE = "none"
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


class Viewer(TimelineViewer):
    """Serves until :meth:`close`.

    Args:
        runs: at least one; the first is shown first.
        address: where browsers come in.
        find_sync: look for the sync offset of the first clip's video at once.
        overrides: of ``conf/sync.yaml``, for the search.

    Raises:
        InputError: the address cannot be listened at, or a setting is wrong.
    """

    def __init__(
        self, runs: Sequence[Run], address: Address, find_sync: bool = False, overrides: Sequence[str] = ()
    ) -> None:
        self._runs = {run.label: run for run in runs}
        self._figures: dict[str, Figure] = {}
        self._trail: list[tuple[Figure, int]] = []
        self._find_sync, self._overrides = find_sync, overrides
        super().__init__(address)

    def _build(self) -> None:
        gui = self._server.gui
        self._world, self._floor = furnish(self._server)
        labels = list(self._runs)
        self._run: Any = gui.add_dropdown("Run", labels, initial_value=labels[0])
        self._compare = gui.add_dropdown("Compare", [_NONE, *labels], initial_value=_NONE, visible=len(labels) > 1)
        takes = list(self._runs[labels[0]].clips)
        self._take: Any = gui.add_dropdown("Take", takes, initial_value=takes[0])
        self._add_timeline()
        self._speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
        self._status = gui.add_markdown("")
        self._video = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="Wearer's video", visible=False)
        self._sync = SyncPanel(gui, self._asked.put, self._move_video, self._overrides)
        self._value = Chart(gui, "Value V(s)")
        self._confidence = Chart(gui, "Fail-safe: confidence, resets")
        self._errors = gui.add_dropdown("Figure", [_NONE], initial_value=_NONE, visible=False)
        self._error = Chart(gui, "Figure per frame")
        self._degrees = gui.add_dropdown("Joint", [_NONE], initial_value=_NONE, visible=False)
        self._angle = Chart(gui, "Joint angle and its band, rad")
        with gui.add_folder("Show", expand_by_default=False):
            self._layers = {n: gui.add_checkbox(n, True) for n in ("reference", "futures", "contacts and torques")}
            self._follow = gui.add_checkbox("follow", True)
            self._again = gui.add_checkbox("loop", True)

        self._on(self._run, self._choose_run)
        self._on(self._compare, self._load)
        self._on(self._take, self._load)
        self._on(self._speed, lambda: setattr(self._player, "speed", float(self._speed.value)))
        self._on(self._errors, self._chart_error)
        self._on(self._degrees, self._chart_angle)
        self._on(self._again, lambda: setattr(self._player, "loop", self._again.value))
        self._load()
        if self._find_sync:
            self._sync.find()

    def _clips(self) -> list[tuple[str, Clip, Color]]:
        """The run shown and the one it is compared with, where both have the take."""
        result: list[tuple[str, Clip, Color]] = []
        for label, color in ((self._run.value, _MAIN), (self._compare.value, _OTHER)):
            run = self._runs.get(label)
            clip = None if run is None else run.clips.get(self._take.value)
            if clip is not None and label not in [name for name, _, _ in result]:
                result.append((label, clip, color))
        return result

    def _choose_run(self) -> None:
        takes = list(self._runs[self._run.value].clips)
        kept = self._take.value if self._take.value in takes else takes[0]
        self._take.options = takes
        self._take.value = kept
        self._load()

    def _load(self) -> None:
        """Put the chosen clips into the scene, from their first frame on."""
        for figure in (*self._figures.values(), *(f for f, _ in self._trail)):
            figure.remove()
        clips, scene = self._clips(), self._server.scene
        _, main, _ = clips[0]
        self._figures = {
            label: Figure(scene, f"/world/run{i}", clip.motion, color, marks=True)
            for i, (label, clip, color) in enumerate(clips)
        }
        if main.reference is not None:
            self._figures["reference"] = Figure(scene, "/world/reference", main.reference, _REFERENCE, 0.35)
        for k, future in enumerate(main.futures):
            self._figures[f"future {k}"] = Figure(scene, f"/world/future{k}", future, _DRAWN, 0.3)
        steps = _STEPS if main.forecast else ()
        self._trail = [
            (Figure(scene, f"/world/ahead{ahead}", main.motion, _MAIN, opacity), ahead) for ahead, opacity in steps
        ]
        self._show_video(main, main.footage)
        self._sync.load(main)
        self._load_timeline(len(main.motion), main.motion.fps)
        self._charts(clips)

    def _show_video(self, clip: Clip, footage: Footage | None) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._pictures = None if footage is None else Pictures(footage, clip.motion.fps, len(clip.motion))
        said = ["rendered"] if footage is not None and footage.rendered else []
        said += ["not seen by the forecast"] if clip.forecast else []
        self._video.label = "Wearer's video" + (f" ({', '.join(said)})" if said else "")

    def _move_video(self, offset: float) -> None:
        """To another sync offset; the body stays at its frame."""
        clip = self._clips()[0][1]
        if clip.footage is not None:
            self._show_video(clip, replace(clip.footage, offset=offset))

    def _charts(self, clips: Sequence[tuple[str, Clip, Color]]) -> None:
        fps = clips[0][1].motion.fps
        for chart, name in ((self._value, "value"), (self._confidence, "confidence")):
            lines = {n: (c.curves[name], _css(color)) for n, c, color in clips if name in c.curves}
            resets = clips[0][1].curves.get("reset")
            if name == "confidence" and resets is not None and resets.any():
                lines["resets" if len(clips) == 1 else f"resets of {clips[0][0]}"] = (resets, "#d33")
            chart.set(lines, fps)
        curves = clips[0][1].curves
        figures = [n for n in curves if n not in ("value", "confidence", "reset") and np.isfinite(curves[n]).any()]
        self._offer(self._errors, figures)
        self._offer(self._degrees, list(clips[0][1].bands))
        self._chart_error()
        self._chart_angle()

    def _offer(self, dropdown: Any, names: Sequence[str]) -> None:
        kept = dropdown.value if dropdown.value in names else (names[0] if names else _NONE)
        dropdown.options = tuple(names) or (_NONE,)
        dropdown.value = kept
        dropdown.visible = bool(names)

    def _chart_error(self) -> None:
        name, clips = self._errors.value, self._clips()
        self._error.set({n: (c.curves[name], _css(k)) for n, c, k in clips if name in c.curves}, clips[0][1].motion.fps)

    def _chart_angle(self) -> None:
        clip, name = self._clips()[0][1], self._degrees.value
        lines = {}
        if name in clip.bands:
            joint, _, k = name.rpartition("_")
            skeleton = clip.motion.skeleton
            column = 7 + skeleton.dof_slices[skeleton.names.index(joint)].start + int(k)
            lines = {edge: (clip.bands[name][edge], "#9ab") for edge in ("high", "low")}
            lines["forecast"] = (clip.motion.qpos[:, column], _css(_MAIN))
            if clip.reference is not None and clip.reference.skeleton == skeleton:
                lines["true"] = (clip.reference.qpos[:, column], _css(_REFERENCE))
        self._angle.set(lines, clip.motion.fps, ("high", "low"))

    def _draw(self, frame: int, slow: bool) -> None:
        clips = self._clips()
        layer = {name: box.value for name, box in self._layers.items()}
        with self._server.atomic():
            for name, figure in self._figures.items():
                group = "reference" if name == "reference" else "futures" if name.startswith("future ") else ""
                figure.show(frame, layer.get(group, True), layer["contacts and torques"])
            for figure, ahead in self._trail:
                figure.show(frame + ahead, layer["futures"])
            root = self._figures[clips[0][0]].root(frame) if self._follow.value else np.zeros(3)
            self._world.position = (-root[0], -root[1], 0.0)
            self._floor.position = tile(root)
        picture = None if self._pictures is None else self._pictures.at(frame)
        self._video.visible = picture is not None
        if picture is not None:
            self._video.image = picture
        if not slow:
            return
        self._show_timeline(frame)
        self._status.content = self._line(frame, clips)
        for marked in (self._value, self._confidence, self._error, self._angle, self._sync):
            marked.at(frame)

    def _line(self, frame: int, clips: Sequence[tuple[str, Clip, Color]]) -> str:
        motion = clips[0][1].motion
        parts = [f"frame {frame} of {len(motion)}, {frame / motion.fps:.2f} s", f"blue: {clips[0][0]}"]
        parts += [f"orange: {label}" for label, _, _ in clips[1:]]
        parts += ["green: reference"] if "reference" in self._figures else []
        parts += ["violet: other futures drawn"] if clips[0][1].futures else []
        parts += [f"video: {self._pictures.fault}"] if self._pictures is not None and self._pictures.fault else []
        return "; ".join(parts)


def _css(color: Color) -> str:
    return f"rgb{color}"
