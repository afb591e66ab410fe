"""Is the wearer's video in step with the body? The offset, found or moved by frames, and how both turn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.sync_offset import Sync, find_offset, head_turning, settings_of, video_turning
from egopose.motion.rotations import Array
from egopose.viewer.charts import Chart
from egopose.viewer.clip import Clip, Footage
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera

_FRAME = 1 / 30  # s: what a step of the buttons is, a frame of the method
_STEPS = {"-10": -10, "-1": -1, "+1": 1, "+10": 10}


class SyncPanel:
    """The folder *Sync* of the viewer; there where the wearer's own video is shown.

    Args:
        gui: where it stands.
        ask: carries an order out on the thread that draws.
        move: shows the video at another sync offset (s).
        overrides: of ``conf/sync.yaml``: the camera, the numbers of the search.

    Raises:
        InputError: a setting is wrong.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        ask: Callable[[Callable[[], None]], None],
        move: Callable[[float], None],
        overrides: Sequence[str] = (),
    ) -> None:
        config = compose_config("sync", ["video=-", "motion=-", *overrides])
        self._settings = settings_of(config["data"])
        self._flow = FlowConfig(**config["vision"]["flow"])
        self._camera = Camera.from_mapping(config["data"]["camera"], "data.camera")
        self._mapping = dict(config["mapping"])
        self._ask, self._move = ask, move
        self._clip: Clip | None = None
        self._turning: tuple[Array, Array] | None = None  # of the head and the camera, as find_offset wants them
        self._busy: threading.Thread | None = None
        self._folder = gui.add_folder("Sync", expand_by_default=False)
        with self._folder:
            self._said = gui.add_markdown("")
            self._step: Any = gui.add_button_group("Frames", tuple(_STEPS))
            self._find = gui.add_button("Find", hint="by how head and camera turn; as egopose sync")
            self._print = gui.add_button("Print setting", hint="in the terminal the viewer was started in")
            self._chart = Chart(gui, "Turning of head and camera, rad/s")
        self._step.on_click(lambda event: ask(partial(self._nudge, _STEPS[event.target.value])))
        self._find.on_click(lambda _: ask(self.find))
        self._print.on_click(lambda _: ask(lambda: print(self.setting, flush=True)))
        self.load(None)

    @property
    def setting(self) -> str:
        """What stands in a take's list, see docs/own-data.md."""
        footage = self._footage
        return "" if footage is None else f"sync_offset: {footage.offset:.3f}"

    @property
    def _footage(self) -> Footage | None:
        return None if self._clip is None else self._clip.footage

    def load(self, clip: Clip | None) -> None:
        """Another clip, or one whose video is not the wearer's own."""
        self._clip = clip if clip is not None and clip.footage is not None and not clip.footage.last_panel else None
        self._turning = None
        self._folder.visible = self._clip is not None
        self._tell("")

    def at(self, frame: int) -> None:
        """Mark a frame."""
        self._chart.at(frame)

    def find(self) -> None:
        """Look for the offset; the answer comes when it is found."""
        clip = self._clip
        if clip is None or (self._busy is not None and self._busy.is_alive()):
            return
        self._tell("looking for the offset...")
        self._busy = threading.Thread(target=self._look, args=(clip,), daemon=True)
        self._busy.start()

    def _look(self, clip: Clip) -> None:
        footage, rate = clip.footage, self._settings.rate
        assert footage is not None
        try:
            camera = replace(self._camera, fps=footage.taken_at) if footage.taken_at else self._camera
            head = head_turning(clip.motion, rate, self._mapping)
            seen = video_turning(footage.path, camera, self._flow, rate, self._settings.field_of_view)
        except InputError as error:
            self._ask(partial(self._fail, clip, str(error)))
            return
        self._ask(partial(self._answer, clip, head, seen))

    def _fail(self, clip: Clip, cause: str) -> None:
        if clip is self._clip:
            self._tell(cause)

    def _answer(self, clip: Clip, head: Array, camera: Array) -> None:
        if clip is not self._clip:
            return
        self._turning = head, camera
        try:
            result: Sync = find_offset(head, camera, self._settings, "sync")
        except InputError as error:
            self._tell(f"{error}")
            return
        assert clip.footage is not None
        self._set(result.offset - clip.footage.start)
        self._tell(f"found: correlation {result.correlation:.2f}, confidence {result.confidence:.2f}")

    def _nudge(self, frames: int) -> None:
        if (footage := self._footage) is not None:
            self._set(footage.offset + frames * _FRAME)
            self._tell("moved by hand")

    def _set(self, offset: float) -> None:
        assert self._clip is not None
        assert self._clip.footage is not None
        self._clip = replace(self._clip, footage=replace(self._clip.footage, offset=offset))
        self._move(offset)

    def _tell(self, what: str) -> None:
        self._said.content = "\n\n".join(part for part in (f"`{self.setting}`", what) if part)
        self._draw()

    def _draw(self) -> None:
        """Both angular speeds on the clip's time, the camera's moved by the offset."""
        if self._clip is None or self._turning is None or self._clip.footage is None:
            self._chart.set({}, 30.0)
            return
        motion, footage = self._clip.motion, self._clip.footage
        times = np.arange(len(motion)) / motion.fps
        head, camera = (np.linalg.norm(turning, axis=1) for turning in self._turning)
        shown = {
            "head": (self._sampled(head, times), "rgb(70,110,220)"),
            "camera": (self._sampled(camera, times + footage.start + footage.offset), "rgb(235,140,40)"),
        }
        self._chart.set(shown, motion.fps)

    def _sampled(self, speed: Array, times: Array) -> Array:
        middles = (np.arange(len(speed)) + 0.5) / self._settings.rate
        return np.interp(times, middles, speed, left=np.nan, right=np.nan)
