"""What must be set before torch and dm_control are imported. This module imports nothing heavy."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from egopose.core.opengl import switch_off_what_cannot_work


def prepare_runtime() -> None:
    """Call first in every main, before anything imports torch.

    OpenMP's idle threads spin by default and starve the physics' threads of the same cores; these settings make them
    sleep. Values already in the environment win.

    MuJoCo and dm_control bind an OpenGL back end when they are imported; one that cannot work is switched off for them
    (:mod:`egopose.core.opengl`). This project's own choice of a back end comes later (:mod:`egopose.vision.gl`). absl
    tells of each attempt, which says nothing about that choice.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    switch_off_what_cannot_work()
    logging.getLogger("absl").setLevel(logging.WARNING)


def end_with_parent() -> None:
    """Call in a process that works for another: it ends as soon as that one is gone, whatever it is doing then.

    A process that is killed cannot tell those it started. Does nothing in a process that Python did not start.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end-with-parent", daemon=True).start()


@contextmanager
def libraries_loading() -> Iterator[None]:
    """Around imports of large libraries: without collections of the garbage that they do not make.

    torch and TorchRL make a million objects that stay; looking through them again and again takes a fifth of the time.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def settle_heap() -> None:
    """Call when all that a long loop works with is made.

    Python's full garbage collections walk every object of the libraries, 0.2 s in the middle of every third iteration
    of training; what is there now they leave out from here on.
    """
    gc.collect()
    gc.freeze()
