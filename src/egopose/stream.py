"""``python -m egopose.stream source=0|VIDEO|ADDRESS|take:NAME checkpoint=RUN``: motion, live, and forecasts of it."""

from __future__ import annotations

import signal
import sys
import threading

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError


@command("stream")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.inference.stream.build import print_report, stream

    stop = threading.Event()
    # Not an exception out of nowhere: what was seen so far is to be written whole.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        print_report(stream(resolved(config), stop))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
