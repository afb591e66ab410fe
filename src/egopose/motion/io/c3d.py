"""C3D, the biomechanics laboratory's file: points in mm, force platforms and analog channels.

Joint centres and limb ends are its points; rotations have no place. Every body on the ground is a force platform of
type 2 whose origin is the world's: its channels hold force (N) and moment about the origin (N mm), so that a pressure
point that walks along fits. Contacts (0, 1) and torques (N m) are analog channels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.c3d_syntax import Value, labels, write_container
from egopose.motion.io.frames import up_rotation
from egopose.motion.io.markers import dof_names, markers, plain_names
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

_MM = 1000.0
#: Corners of a platform around the world's origin (m), from the quadrant of x and y both positive: the platform's axes
#: are then the world's. The size means nothing.
_CORNERS = np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.0], [0.5, -0.5, 0.0]])


def write_c3d(motion: Motion, path: str | Path, *, up: str = "z") -> None:
    """Write a C3D file.

    Platforms give the ground's force on the body, along the file's axes. C3D leaves the sign to the laboratory; this
    is the one that readers which turn platforms into ground reactions (ezc3d among them) hand through.

    Args:
        motion: z up, metres.
        path: the file; its folder must exist.
        up: the file's up axis; POINT:Y_SCREEN declares it.

    Raises:
        KeyError: an unknown up axis.
        ValueError: more joints than the format has room for.
    """
    world = rot.conjugate(up_rotation(up))
    names, positions = markers(motion)
    channel_names, units, channels, platforms = _channels(motion)
    rate = np.array([motion.fps])
    screen = ("-" if up.startswith("-") else "+") + up[-1].upper()
    groups: dict[str, dict[str, Value]] = {
        "POINT": {
            "RATE": rate,
            "UNITS": "mm",
            "X_SCREEN": "+Y" if up.endswith("x") else "+X",
            "Y_SCREEN": screen,
            **labels("LABELS", names),
            **labels("DESCRIPTIONS", names),
        },
        "ANALOG": {
            "RATE": rate,
            "SCALE": np.ones(len(channel_names)),
            "OFFSET": np.zeros(len(channel_names), dtype=np.int64),
            **labels("LABELS", channel_names),
            **labels("DESCRIPTIONS", channel_names),
            **labels("UNITS", units),
        },
    }
    if platforms:
        corners = _MM * rot.rotate(world, _CORNERS)
        groups["FORCE_PLATFORM"] = {
            "USED": np.array([platforms]),
            "TYPE": np.full(platforms, 2),
            "ZERO": np.array([1, 0]),
            "CHANNEL": (1 + np.arange(6 * platforms)).reshape(platforms, 6).T,
            "CORNERS": np.repeat(corners.T[:, :, None], platforms, axis=2),
            "ORIGIN": np.zeros((3, platforms)),
        }
    write_container(Path(path), groups, _MM * rot.rotate(world, positions), channels)


def _channels(motion: Motion) -> tuple[list[str], list[str], Array, int]:
    """Names, units and values ``[T, channels]``, and how many platforms stand first among them with 6 channels each."""
    names: list[str] = []
    units: list[str] = []
    columns: list[Array] = [np.empty((len(motion), 0))]
    platforms = 0
    if motion.ground_reaction is not None:
        # A platform's channels are along its own axes, which are the world's before the file's up axis turns them.
        ground = motion.ground_reaction
        moments = _MM * ground.about(np.zeros(3))
        platforms = len(ground.bodies)
        for k, body in enumerate(plain_names(list(ground.bodies))):
            names += [f"{body}_{part}{axis}" for part in "FM" for axis in "xyz"]
            units += ["N"] * 3 + ["Nmm"] * 3
            columns += [ground.force[:, k], moments[:, k]]
    if motion.contacts is not None:
        points = motion.contact_names or tuple(f"point{k}" for k in range(motion.contacts.shape[1]))
        names += [f"{name}_contact" for name in plain_names(list(points))]
        units += [""] * motion.contacts.shape[1]
        columns.append(motion.contacts.astype(np.float64))
    if motion.torques is not None:
        names += [f"{name}_torque" for name in dof_names(motion)]
        units += ["Nm"] * motion.torques.shape[1]
        columns.append(motion.torques)
    return names, units, np.concatenate(columns, axis=1), platforms
