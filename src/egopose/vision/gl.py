"""Off-screen OpenGL for MuJoCo: the back end is found by trying, so that rendering works without a display."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

# OSMesa first: in software, but it opened and closed cleanly wherever it was tried, which EGL did not.
_CANDIDATES = {"linux": ("osmesa", "egl", "glfw"), "darwin": ("cgl",), "win32": ("glfw",)}

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{backend}").GLContext(32, 32)
context.make_current()
renderer = mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100)
renderer.free()
context.free()
"""


@functools.cache
def choose_backend() -> str:
    """The name of a back end that works: ``MUJOCO_GL`` where it is set, else the first that passes a trial.

    A back end that fails may abort the process, so each is tried in one of its own. The choice is left in
    ``MUJOCO_GL`` for MuJoCo, dm_control and child processes.

    Raises:
        RuntimeError: none works; the message says what to install.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    candidates = _CANDIDATES.get(sys.platform, ("glfw",))
    if asked in candidates:
        return asked
    for backend in candidates:
        environment = {**os.environ, "MUJOCO_GL": backend}
        # dm_control or PyOpenGL may have left another platform's name there.
        environment.pop("PYOPENGL_PLATFORM", None)
        probe = [sys.executable, "-c", _PROBE.format(backend=backend)]
        try:
            done = subprocess.run(probe, env=environment, capture_output=True, timeout=60, check=False)
        except subprocess.TimeoutExpired:
            continue
        if done.returncode == 0:
            os.environ["MUJOCO_GL"] = backend
            return backend
    raise RuntimeError("no OpenGL without a display here: install one, e.g. `apt-get install libosmesa6`")


def open_context(width: int, height: int) -> Any:
    """A current OpenGL context with ``make_current`` and ``free``.

    Raises:
        RuntimeError: none can be opened; the message says what to install.
    """
    backend = choose_backend()
    try:
        # By module and not by mujoco.GLContext: that one is bound to whatever MUJOCO_GL was at MuJoCo's first import.
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:
        cause = f"OpenGL by {backend} fails ({error}): try MUJOCO_GL=osmesa after `apt-get install libosmesa6`"
        raise RuntimeError(cause) from error
    return context
