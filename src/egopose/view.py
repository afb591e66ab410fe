"""``python -m egopose.view RUN_OR_MOTION [ANOTHER ...]``: look at motions, estimates and forecasts in the browser.

Sources: a motion file, a folder of an estimate, an evaluation's folder or a run directory; several are compared.
Or `ws://127.0.0.1:8765/json`: what `egopose stream` sends, live.
"""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import argparse  # noqa: E402
import secrets  # noqa: E402
import signal  # noqa: E402
import sys  # noqa: E402
import threading  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from importlib.util import find_spec  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING  # noqa: E402

from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from egopose.viewer.live import LiveViewer


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line; serves until it is interrupted."""
    parser = argparse.ArgumentParser(
        prog="egopose view", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sources", nargs="+", metavar="RUN_OR_MOTION")
    parser.add_argument("--video", type=Path, help="the wearer's MP4, of a source that is one motion")
    parser.add_argument("--offset", type=float, default=0.0, help="seconds: the motion's time 0 in the video")
    parser.add_argument("--address", default="127.0.0.1", help="to listen at; any but this machine's own needs a token")
    parser.add_argument("--port", type=int, default=8080, help="0 for a free one")
    parser.add_argument("--token", help="16 letters and digits at least; `new` makes one and prints it")
    options = parser.parse_args(arguments)
    try:
        if find_spec("viser") is None:
            raise InputError("view", "viser", "is not installed; pip install 'egopose[view]'")
        from egopose.viewer.app import Viewer
        from egopose.viewer.clip import Footage
        from egopose.viewer.door import Address
        from egopose.viewer.sources import read_runs

        token = secrets.token_hex(16) if options.token == "new" else options.token
        address = Address(options.address, options.port, token)
        footage = None if options.video is None else Footage(options.video, options.offset)
        viewer: Viewer | LiveViewer
        if options.sources[0].startswith(("ws://", "wss://")):
            from egopose.viewer.live import LiveViewer

            viewer = LiveViewer(options.sources[0], address)
        else:
            viewer = Viewer(read_runs(options.sources, footage), address)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"open {viewer.url} (Ctrl-C ends)", flush=True)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
    viewer.close()


if __name__ == "__main__":
    main()
