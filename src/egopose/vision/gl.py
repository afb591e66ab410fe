"""Off-screen OpenGL for MuJoCo: the back end is found by trying, so that rendering works without a display."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

from egopose.core.errors import NoOpenGL
from egopose.core.opengl import asked_backend, use_backend

# OSMesa first: in software, but it opened and closed cleanly wherever it was tried, which EGL did not.
_CANDIDATES = {"linux": ("osmesa", "egl", "glfw"), "darwin": ("cgl",), "win32": ("glfw",)}

_INSTALL = {
    "osmesa": "`apt-get install libosmesa6`",
    "egl": "`apt-get install libegl1` and the graphics card's driver",
    "glfw": "it needs a display",
}

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
    """The name of a back end: ``MUJOCO_GL`` where it is set, else the first that passes a trial.

    A back end that fails may abort the process, so each is tried in one of its own. The choice is left in
    ``MUJOCO_GL`` for MuJoCo, dm_control and child processes.

    Raises:
        NoOpenGL: none works; says what to install.
    """
    asked = asked_backend()
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
            use_backend(backend)
            return backend
    raise NoOpenGL("OpenGL", "back end", "none works here without a display: `apt-get install libosmesa6`")


def open_context(width: int, height: int) -> Any:
    """A current OpenGL context with ``make_current`` and ``free``.

    Raises:
        NoOpenGL: none can be opened; says what to install.
    """
    backend = choose_backend()
    try:
        # By module and not by mujoco.GLContext: that one is bound to whatever MUJOCO_GL was at MuJoCo's first import.
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:
        told = " ".join(str(error).split())[:100]
        cause = f"fails ({told}): {_INSTALL.get(backend, 'try another')}, or unset MUJOCO_GL to have one found"
        raise NoOpenGL("MUJOCO_GL", backend, cause) from error
    return context
