"""``python -m egopose.view RUN_OR_MOTION [ANOTHER ...]``: look at motions, estimates and forecasts in the browser.

Sources: a motion file, a folder of an estimate, an evaluation's folder or a run directory; several are compared.
Or `ws://127.0.0.1:8765/json`: what `egopose stream` sends, live. Or a folder of `egopose reconstruct prepare`: its
scene, to be changed and saved; a reconstruction's folder: what came of it.
Words key=value are overrides of conf/sync.yaml: how motion files are read (reader.up=y) and, for `--offset auto` and
the viewer's button Find, the camera.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from egopose.core.errors import InputError


def _offset(word: str) -> float | None:
    """Seconds; None for one that is to be found."""
    try:
        return None if word == "auto" else float(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be seconds or `auto`, not {word!r}") from None


def command_line() -> argparse.ArgumentParser:
    """What may stand in the command."""
    parser = argparse.ArgumentParser(
        prog="egopose view", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sources", nargs="+", metavar="RUN_OR_MOTION")
    parser.add_argument("--video", type=Path, help="the wearer's MP4, of a source that is one motion")
    parser.add_argument(
        "--offset", type=_offset, default=0.0, metavar="S", help="the motion's time 0 in the video; `auto` finds it"
    )
    parser.add_argument("--scene", action="store_true", help="of a reconstruction: its scene, to be changed and saved")
    parser.add_argument("--simulated", type=Path, metavar="NPZ", help="of a prepared clip: what `evaluate` made of it")
    parser.add_argument("--address", default="127.0.0.1", help="to listen at; any but this machine's own needs a token")
    parser.add_argument("--port", type=int, default=8080, help="0 for a free one")
    parser.add_argument("--token", help="16 letters and digits at least; `new` makes one and prints it")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line; serves until it is interrupted."""
    from egopose.viewer.session import open_viewer

    given = command_line().parse_args(arguments)
    try:
        where = (given.address, given.port, given.token)
        viewer = open_viewer(given.sources, given.video, given.offset, *where, given.scene, given.simulated)
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
