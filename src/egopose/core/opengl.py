"""Which OpenGL the environment asks for, and keeping one that cannot work from MuJoCo and dm_control.

Both bind a back end when they are imported, by ``MUJOCO_GL``. Where it cannot work the import fails or warns, even for
what draws nothing. This module imports nothing heavy.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from typing import Any

_FOR_MUJOCO = "MUJOCO_GL"
_OFF = "off"
#: What ``MUJOCO_GL`` was where it is switched off here; drawing begins from it, in child processes too.
_ASKED = "EGOPOSE_GL"


def asked_backend() -> str:
    """The back end that was asked for by ``MUJOCO_GL``; empty for whichever works."""
    chosen = os.environ.get(_FOR_MUJOCO, "")
    return (os.environ.get(_ASKED, chosen) if chosen == _OFF else chosen).strip().lower()


def use_backend(name: str) -> None:
    """Leave a back end that was tried in ``MUJOCO_GL``, for MuJoCo, dm_control and child processes."""
    os.environ[_FOR_MUJOCO] = name
    os.environ.pop(_ASKED, None)


def switch_off_what_cannot_work() -> None:
    """Have MuJoCo and dm_control imported without OpenGL where the one they would bind cannot work.

    What cannot: a window without a display, a library that is missing, EGL without a device.
    """
    if sys.platform != "linux":
        return
    asked = asked_backend()
    works = _WORKS.get(asked)
    if works is not None and not works():
        os.environ[_ASKED], os.environ[_FOR_MUJOCO] = asked, _OFF


def _display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _library(name: str) -> Any:
    """As PyOpenGL looks for it; None where it is not there."""
    for file in (f"lib{name}.so", *(f"lib{name}.so.{version}" for version in range(9, -1, -1))):
        try:
            return ctypes.CDLL(file)
        except OSError:
            continue
    return None


def _osmesa() -> bool:
    library = _library("OSMesa")
    return hasattr(library, "OSMesaCreateContextExt") and hasattr(library, "glGetError")


def _egl() -> bool:
    """Whether there is a device, see https://registry.khronos.org/EGL/extensions/EXT/EGL_EXT_device_enumeration.txt"""
    library = _library("EGL")
    if not hasattr(library, "eglGetProcAddress"):
        return False
    library.eglGetProcAddress.restype = ctypes.c_void_p
    address = library.eglGetProcAddress(b"eglQueryDevicesEXT")
    if not address:
        return False
    devices = ctypes.c_int(0)
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))(address)
    return bool(query(0, None, ctypes.byref(devices))) and devices.value > 0


_WORKS: dict[str, Callable[[], bool]] = {
    "": _display,
    "glfw": _display,
    "glx": _display,
    "osmesa": _osmesa,
    "egl": _egl,
}
