"""A body that stands is in balance: how one camera's poses must be turned so that they could stand.

One camera tells little about depth, so that lifted poses lean towards it or away from it by tenths of a radian. Over
some steps a body's centre of mass is above its feet. The lean is a slow turn of the whole body about its feet that
brings it there. It is one linear least-squares problem. Where poses are right it takes away a little of a run's own
leaning, so it is a second reference beside the poses as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class BalanceSettings:
    """Scales of the residuals: what counts as much as what.

    Args:
        sole: m, that the point which carries may be away from the middle of a foot.
        depth: rad, of leans towards the camera and away from it.
        across: rad, of leans to the side in the picture, where poses are seen well.
        rate: rad/s, of a lean: a person's own leaning in a step is quicker.
    """

    sole: float = 0.12
    depth: float = 0.25
    across: float = 0.05
    rate: float = 0.1


def lean(
    feet: Array,
    contacts: np.ndarray,
    center_of_mass: Array,
    sight: Array,
    fps: float,
    settings: BalanceSettings | None = None,
) -> Array:
    """``[T, 3]`` rotation vectors (rad, level) by which a body is turned about its feet to be in balance.

    Args:
        feet: ``[T, F, 3]`` m, the middle of each sole; any origin, z up.
        contacts: ``[T, F]`` whether the foot carries.
        center_of_mass: ``[T, 3]`` m, from the same origin.
        sight: ``[T, 3]`` unit vectors from the camera to the person.
        fps: frames per second.
        settings: see :class:`BalanceSettings`; None for its own values.
    """
    frames, settings = len(feet), settings or BalanceSettings()
    stands = np.asarray(contacts, dtype=bool)
    count = stands.sum(axis=1)
    carried = np.where(stands[..., None], feet, 0.0).sum(axis=1) / np.maximum(count, 1)[:, None]
    away = center_of_mass - carried
    # The feet's distance from their middle: between them the point may be anywhere.
    spread = np.where(stands, np.linalg.norm((feet - carried[:, None])[..., :2], axis=2), 0.0).max(axis=1)
    weight = np.where(count > 0, 1.0 / (settings.sole + spread), 0.0)
    height = np.maximum(away[:, 2], 0.1)
    # A turn by (x, y) moves the centre of mass by h (y, -x).
    level = sight[:, :2] / np.maximum(np.linalg.norm(sight[:, :2], axis=1, keepdims=True), 1e-9)
    forward, side = level, np.stack([-level[:, 1], level[:, 0]], axis=1)
    # Moves of the centre of mass over its height: u (T, 2), in the world.
    eye = sparse.eye_array(frames, format="csr")
    rows = [sparse.kron(sparse.diags_array(weight * height), sparse.eye_array(2), format="csr")]
    values = [(-away[:, :2] * weight[:, None]).ravel()]
    for axis, scale in ((forward, settings.depth), (side, settings.across)):
        rows.append(sparse.block_diag(list(axis[:, None] / scale), format="csr"))
        values.append(np.zeros(frames))
    if frames > 1:
        change = (sparse.eye_array(frames, k=1, format="csr")[:-1] - eye[:-1]) * (fps / settings.rate)
        rows.append(sparse.kron(change, sparse.eye_array(2), format="csr"))
        values.append(np.zeros(2 * (frames - 1)))
    matrix = sparse.vstack(rows, format="csr")
    normal = (matrix.T @ matrix).tocsc()
    moved = sparse.linalg.spsolve(normal, matrix.T @ np.concatenate(values)).reshape(frames, 2)
    return np.column_stack([-moved[:, 1], moved[:, 0], np.zeros(frames)])


def leaned(qpos: Array, turn: Array, pivot: Array) -> Array:
    """Poses ``[T, nq]`` turned as a whole by ``turn [T, 3]`` (rad, world axes) about ``pivot [T, 3]`` (m)."""
    out, by = qpos.copy(), rot.from_rotvec(turn)
    out[:, :3] = pivot + rot.rotate(by, qpos[:, :3] - pivot)
    out[:, 3:7] = rot.multiply(by, qpos[:, 3:7])
    return out
