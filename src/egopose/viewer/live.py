"""What `egopose stream` sends, as it comes: the body, its forecast, its value and the fail-safe's confidence."""

from __future__ import annotations

import json
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from egopose.core.errors import InputError
from egopose.motion.io.native import skeleton_from_json
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.viewer.auth_proxy import Address
from egopose.viewer.charts import Chart
from egopose.viewer.figure import Color
from egopose.viewer.serving import furnish, open_server, tile
from egopose.viewer.shapes import surface_of

#: Frames ahead and opacity: the poses of a forecast that are shown, fading.
AHEAD = ((12, 0.4), (24, 0.26), (45, 0.15), (75, 0.09))

#: Of a frame's message, and the titles of their charts; resets stand in the last.
CHARTS = {"value": "Value V(s)", "confidence": "Fail-safe: confidence, resets"}

_KEPT = 300  # frames in the charts: 10 s
_TICK = 1 / 30
_CHARTS_EVERY = 30  # pictures between charts: 1 s
_BODY: Color = (70, 110, 220)
_NONE = "none"
_LARGEST = 2**24  # bytes of a message: a forecast of 30 s with bands is one million


@dataclass(frozen=True, eq=False)
class _Coming:
    """A forecast: row 0 is the frame after ``frame``; ``bands`` are low and high ``[H, nu]`` rad, or None."""

    frame: int
    qpos: Array
    positions: Array
    quats: Array
    bands: tuple[Array, ...] | None


class LiveViewer:
    """Shows the newest frame of a stream until :meth:`close`.

    Args:
        source: ``ws://`` address of the stream, with ``?token=`` where it asks for one.
        address: where browsers come in.

    Attributes:
        frame: the newest shown, -1 before the first.
        forecast: the frame that the forecast shown begins after, -1 before the first.

    Raises:
        InputError: no stream there, or it does not speak as ours; the address cannot be listened at.
    """

    def __init__(self, source: str, address: Address) -> None:
        try:
            self._stream = connect(source, proxy=None, max_size=_LARGEST)
            hello = json.loads(self._stream.recv(timeout=10))
            self._skeleton, self._fps = skeleton_from_json(hello["skeleton"]), float(hello["fps"])
        except (OSError, WebSocketException, ValueError, KeyError, TypeError) as error:
            cause = " ".join(str(error).split())[:200]
            raise InputError(
                source.partition("?")[0], "stream", f"{cause}; is `egopose stream` running there?"
            ) from None
        self._server, self._door, self.url = open_server(address)
        _, self._floor = furnish(self._server)
        self._surface = surface_of(self._skeleton)
        rest = self._surface.posed(
            *(x[0] for x in forward_kinematics(self._skeleton, self._skeleton.rest_qpos()[None]))
        )
        scene, gui = self._server.scene, self._server.gui
        self._mesh = scene.add_mesh_simple("/world/live", rest, self._surface.faces, color=_BODY)
        self._poses_ahead = [
            scene.add_mesh_simple(
                f"/world/ahead{ahead}", rest, self._surface.faces, color=_BODY, opacity=opacity, cast_shadow=False,
                visible=False,
            )
            for ahead, opacity in AHEAD
        ]  # fmt: skip
        self._status = gui.add_markdown("waiting")
        self._charts = {n: Chart(gui, title) for n, title in CHARTS.items()}
        joints = self._skeleton.joints
        self._degrees = [f"{joint.name}_{k}" for joint in joints[1:] for k in range(len(joint.dofs))]
        self._joint: Any = gui.add_dropdown("Joint", [_NONE, *self._degrees], initial_value=_NONE, visible=False)
        self._angle = Chart(gui, "Forecast of a joint angle and its band, rad")
        self._past: dict[str, deque[float]] = {n: deque(maxlen=_KEPT) for n in (*CHARTS, "reset")}
        self._newest: dict[str, Any] | None = None
        self._coming: _Coming | None = None
        self._stop = threading.Event()
        self.frame = self.forecast = -1
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._listen, self._show)]
        for thread in self._threads:
            thread.start()

    def _listen(self) -> None:
        try:
            for text in self._stream:
                message = json.loads(text)
                if message.get("type") == "frame":
                    for name, past in self._past.items():
                        past.append(np.nan if message[name] is None else float(message[name]))
                    self._newest = message
                elif message.get("type") == "forecast":
                    self._coming = self._read_forecast(message)
        except (OSError, WebSocketException, ValueError, KeyError, TypeError):
            pass  # told below: nothing comes any more
        self._stop.set()

    def _read_forecast(self, message: dict[str, Any]) -> _Coming:
        qpos = np.array(message["qpos"], dtype=np.float64).reshape(-1, self._skeleton.nq)
        bands = None
        if message["low"] is not None:
            shape = len(qpos), self._skeleton.nq - 7
            bands = tuple(np.array(message[edge], dtype=np.float64).reshape(shape) for edge in ("low", "high"))
        return _Coming(int(message["frame"]), qpos, *forward_kinematics(self._skeleton, qpos), bands)

    def _show(self) -> None:
        shown = 0
        while not self._stop.wait(_TICK):
            newest = self._newest
            if newest is None or newest["frame"] == self.frame:
                continue
            self.frame = int(newest["frame"])
            qpos = np.array(newest["qpos"], dtype=np.float64)[None]
            coming = self._coming
            # The bodies come to the camera, not the camera to them: a slow browser shows new meshes late.
            root = qpos[0, :3] * [1.0, 1.0, 0.0]
            positions, quats = (x[0] for x in forward_kinematics(self._skeleton, qpos))
            with self._server.atomic():
                self._mesh.vertices = self._surface.posed(positions - root, quats)
                self._floor.position = tuple(np.subtract(tile(root), root))
                if coming is not None:
                    self._show_ahead(coming, root)
            self._status.content = f"live, frame {self.frame}, {newest['delay_ms']:.0f} ms behind"
            shown += 1
            if shown % _CHARTS_EVERY == 0:
                self._chart_past()
                if coming is not None:
                    self._chart_ahead(coming)
        self._status.content = f"ended after frame {self.frame}"

    def _chart_past(self) -> None:
        """The last seconds, up to 0 s."""
        past = {name: np.array(values) for name, values in self._past.items()}
        for name, chart in self._charts.items():
            lines = {name: (past[name], f"rgb{_BODY}")}
            if name == "confidence" and past["reset"].any():
                lines["resets"] = (past["reset"], "#d33")
            last = len(past[name]) - 1
            chart.set(lines, self._fps, begin=-last / self._fps, now=last)

    def _show_ahead(self, coming: _Coming, root: Array) -> None:
        """The poses some frames after the one shown, as far as the newest forecast reaches."""
        for shape, (ahead, _) in zip(self._poses_ahead, AHEAD, strict=True):
            row = self.frame + ahead - coming.frame - 1
            shape.visible = 0 <= row < len(coming.qpos)
            if shape.visible:
                shape.vertices = self._surface.posed(coming.positions[row] - root, coming.quats[row])
        self._joint.visible = True
        self.forecast = coming.frame

    def _chart_ahead(self, coming: _Coming) -> None:
        name, lines = self._joint.value, {}
        if name != _NONE:
            column = self._degrees.index(name)
            if coming.bands is not None:
                low, high = (edge[:, column] for edge in coming.bands)
                lines = {"high": (high, "#9ab"), "low": (low, "#9ab")}
            lines["forecast"] = (coming.qpos[:, 7 + column], f"rgb{_BODY}")
        behind = self.frame - coming.frame - 1
        self._angle.set(lines, self._fps, ("high", "low"), begin=-behind / self._fps, now=behind)

    def close(self) -> None:
        """Leave the stream and serve no more."""
        self._stop.set()
        self._stream.close()
        for thread in self._threads:
            thread.join()
        self._door.close()
        self._server.stop()
