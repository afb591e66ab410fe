"""What `egopose stream` sends, as it comes: the body, its value and the fail-safe's confidence."""

from __future__ import annotations

import json
import threading
from collections import deque
from typing import Any

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from egopose.errors import InputError
from egopose.motion.io.native import skeleton_from_json
from egopose.motion.kinematics import forward_kinematics
from egopose.viewer.curves import Chart
from egopose.viewer.door import Address
from egopose.viewer.serving import furnish, open_server
from egopose.viewer.shapes import surface_of

_KEPT = 300  # frames in the charts: 10 s
_TICK = 1 / 30


class LiveViewer:
    """Shows the newest frame of a stream until :meth:`close`.

    Args:
        source: ``ws://`` address of the stream, with ``?token=`` where it asks for one.
        address: where browsers come in.

    Attributes:
        frame: the newest shown, -1 before the first.

    Raises:
        InputError: no stream there, or it does not speak as ours; the address cannot be listened at.
    """

    def __init__(self, source: str, address: Address) -> None:
        try:
            self._stream = connect(source, proxy=None)
            hello = json.loads(self._stream.recv(timeout=10))
            self._skeleton, self._fps = skeleton_from_json(hello["skeleton"]), float(hello["fps"])
        except (OSError, WebSocketException, ValueError, KeyError, TypeError) as error:
            raise InputError(source.partition("?")[0], "stream", " ".join(str(error).split())[:200]) from None
        self._server, self._door, self.url = open_server(address)
        self._world = furnish(self._server)
        self._surface = surface_of(self._skeleton)
        rest = self._surface.posed(
            *(x[0] for x in forward_kinematics(self._skeleton, self._skeleton.rest_qpos()[None]))
        )
        self._mesh = self._server.scene.add_mesh_simple("/world/live", rest, self._surface.faces, color=(70, 110, 220))
        self._status = self._server.gui.add_markdown("waiting")
        self._charts = {n: Chart(self._server.gui, n) for n in ("value", "confidence")}
        self._past: dict[str, deque[float]] = {n: deque(maxlen=_KEPT) for n in self._charts}
        self._newest: dict[str, Any] | None = None
        self._stop = threading.Event()
        self.frame = -1
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
        except (OSError, WebSocketException, ValueError, KeyError, TypeError):
            pass  # told below: nothing comes any more
        self._stop.set()

    def _show(self) -> None:
        while not self._stop.wait(_TICK):
            newest = self._newest
            if newest is None or newest["frame"] == self.frame:
                continue
            self.frame = int(newest["frame"])
            qpos = np.array(newest["qpos"], dtype=np.float64)[None]
            self._mesh.vertices = self._surface.posed(*(x[0] for x in forward_kinematics(self._skeleton, qpos)))
            self._world.position = (-qpos[0, 0], -qpos[0, 1], 0.0)
            self._status.content = f"live, frame {self.frame}, {newest['delay_ms']:.0f} ms behind"
            if self.frame % 60 == 0:
                for name, chart in self._charts.items():
                    chart.set({name: (np.array(self._past[name]), "rgb(70,110,220)")}, self._fps)
        self._status.content = f"ended after frame {self.frame}"

    def close(self) -> None:
        """Leave the stream and serve no more."""
        self._stop.set()
        self._stream.close()
        for thread in self._threads:
            thread.join()
        self._door.close()
        self._server.stop()
