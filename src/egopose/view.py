"""``python -m egopose.view RUN_OR_MOTION [ANOTHER ...]``: look at motions, estimates and forecasts in the browser.

Sources: a motion file, a folder of an estimate, an evaluation's folder or a run directory; several are compared.
Or `ws://127.0.0.1:8765/json`: what `egopose stream` sends, live.
Words key=value are overrides of conf/sync.yaml (the camera), for `--offset auto` and the viewer's button Find.
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


_LIVE = ("ws://", "wss://")


def _offset(word: str) -> float | None:
    """Seconds; None for one that is to be found."""
    try:
        return None if word == "auto" else float(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be seconds or `auto`, not {word!r}") from None


def _is_source(word: str) -> bool:
    return word.startswith(_LIVE) or Path(word).exists()


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
    parser.add_argument("--address", default="127.0.0.1", help="to listen at; any but this machine's own needs a token")
    parser.add_argument("--port", type=int, default=8080, help="0 for a free one")
    parser.add_argument("--token", help="16 letters and digits at least; `new` makes one and prints it")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line; serves until it is interrupted."""
    options = command_line().parse_args(arguments)
    try:
        if find_spec("viser") is None:
            raise InputError("view", "viser", "is not installed; pip install 'egopose[view]'")
        from egopose.motion.plausibility import source_findings, tell
        from egopose.viewer.app import Viewer
        from egopose.viewer.clip import Footage
        from egopose.viewer.door import Address
        from egopose.viewer.sources import read_runs
        from egopose.vision.video import probe_video

        overrides = [word for word in options.sources if "=" in word and not _is_source(word)]
        sources = [word for word in options.sources if word not in overrides]
        if not sources:
            raise InputError("view", "source", "none is named: a motion file, an evaluation, a run or ws:// address")
        token = secrets.token_hex(16) if options.token == "new" else options.token
        address = Address(options.address, options.port, token)
        find_sync = options.offset is None
        footage = None if options.video is None else Footage(options.video, options.offset or 0.0)
        viewer: Viewer | LiveViewer
        if sources[0].startswith(_LIVE):
            from egopose.viewer.live import LiveViewer

            if len(sources) > 1:
                raise InputError("view", "source", "a live stream is shown by itself; name nothing beside it")
            viewer = LiveViewer(sources[0], address)
        else:
            if footage is not None:
                probe_video(footage.path)
            runs = read_runs(sources, footage)
            for source, run in zip(sources, runs, strict=True):
                for name, clip in run.clips.items() if Path(source).is_file() else ():
                    tell(source_findings(clip.motion), name, lambda line: print(line, file=sys.stderr))
            viewer = Viewer(runs, address, find_sync, overrides)
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
