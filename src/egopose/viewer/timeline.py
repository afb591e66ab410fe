"""What viewers of clips share: a server, one timeline, and one thread that carries out orders and draws."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from egopose.viewer.auth_proxy import Address
from egopose.viewer.player import Player
from egopose.viewer.serving import open_server
from egopose.viewer.video_panel import Pictures

_TICK = 1 / 30  # s between pictures
_CHARTS_EVERY = 3  # pictures between charts and the slider while a clip plays
_LOOK_AGAIN = 30  # ticks after which pictures that have come in late are shown


class TimelineViewer:
    """Serves until :meth:`close`. A subclass builds its panel and its scene in :meth:`_build` and shows a frame in
    :meth:`_draw`.

    A subclass has what its :meth:`_build` needs before it calls this constructor, at whose end the thread runs.

    Args:
        address: where browsers come in.

    Attributes:
        url: what to open.

    Raises:
        InputError: the address cannot be listened at, or what :meth:`_build` raises.
    """

    def __init__(self, address: Address) -> None:
        self._server, self._door, self.url = open_server(address)
        self._player = Player()
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._pictures: Pictures | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, daemon=True)
        try:
            # Here and not on the thread: the first figure reads conf/humanoid, and Hydra composes for one thread at a
            # time.
            self._build()
        except BaseException:
            self._shut()
            raise
        self._thread.start()

    def close(self) -> None:
        """Serve no more."""
        self._stop.set()
        self._thread.join()
        self._shut()

    def _shut(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._door.close()
        self._server.stop()

    def _build(self) -> None:
        raise NotImplementedError

    def _draw(self, frame: int, slow: bool) -> None:
        """Show a frame; ``slow``: also what need not keep up with a clip that plays."""
        raise NotImplementedError

    def _add_timeline(self) -> None:
        """The slider and the button that plays, at this place in the panel."""
        gui = self._server.gui
        self._frame: Any = gui.add_slider("Frame", 0, 1, 1, 0)
        self._play = gui.add_button("Play")

        @self._frame.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._asked.put(partial(self._scrub, int(event.target.value)))

        self._on_click(self._play, lambda: self._player.play(not self._player.playing))

    def _load_timeline(self, frames: int, fps: float) -> None:
        """Another clip, from its first frame on."""
        self._player.load(frames, fps)
        self._frame.value = 0
        self._frame.max = max(1, frames - 1)

    def _show_timeline(self, frame: int) -> None:
        self._frame.value = frame
        self._play.label = "Pause" if self._player.playing else "Play"

    def _scrub(self, frame: int) -> None:
        self._player.play(False)
        self._player.seek(frame)

    def _on(self, handle: Any, action: Callable[[], None]) -> None:
        """Carry out an order when a browser changes a value.

        Values set from here call back too; only what a browser asked for is an order. All orders are carried out by one
        thread, the one that draws.
        """

        @handle.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._asked.put(action)

    def _on_click(self, button: Any, action: Callable[[], None]) -> None:
        button.on_click(lambda _: self._asked.put(action))

    def _loop(self) -> None:
        ticks, shown = 0, (-1, False)
        while not self._stop.wait(_TICK):
            changed = False
            while not self._asked.empty():
                self._asked.get()()
                changed = True
            now = (self._player.frame(), self._player.playing)
            ticks += 1
            if now != shown or changed or ticks % _LOOK_AGAIN == 0:
                self._draw(now[0], changed or not now[1] or ticks % _CHARTS_EVERY == 0)
            shown = now
