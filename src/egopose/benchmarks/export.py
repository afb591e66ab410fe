"""What every export format loses: a motion with forces written, read by other people's packages, and compared.

The truth of positions and rotations is MuJoCo's own kinematics of the humanoid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

import egopose
from egopose.benchmarks.read_back import ReadBack, readers
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import reference_motion
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion, write_motion
from egopose.motion.io.amass import rest_positions
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: An embedded clip: both feet take turns, arms swing.
_CLIP = Path(egopose.__file__).parent / "assets/clips/deepmimic_walk.motion.npz"


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Write one embedded clip in every format and read it back.

    Args:
        overrides: of ``conf/train.yaml`` (the humanoid).
        rounds: of writing and reading; the errors are the largest of all.

    Returns:
        ``{ending: errors}`` of :func:`round_trip`, and ``table``: the same as Markdown.

    Raises:
        InputError: an override is wrong, or a reading package is missing.
    """
    settings = dict(compose_config("export")["forces"])
    humanoid = humanoid_of(compose_config("train", list(overrides)))
    clip, _ = reference_motion(read_motion(_CLIP), humanoid)
    chosen = {key: value for key, value in settings.items() if key not in ("enabled", "humanoid")}
    motion = with_forces(humanoid, clip, from_mapping(ForceSettings, chosen, "conf/export.yaml: forces"))
    result: dict[str, dict[str, Any]] = {}
    for _ in range(rounds):
        with TemporaryDirectory() as folder:
            for ending, errors in round_trips(humanoid, motion, Path(folder)).items():
                before = result.setdefault(ending, errors)
                result[ending] = {k: max(v, before[k]) if isinstance(v, float) else v for k, v in errors.items()}
    return {**result, "table": "\n" + as_markdown(result)}


def round_trips(humanoid: HumanoidModel, motion: Motion, folder: Path) -> dict[str, dict[str, Any]]:
    """Errors of every format by its ending, files left in ``folder``.

    Raises:
        InputError: a reading package is missing.
    """
    out = {}
    for ending, read in readers(rest_positions()[0].tolist()).items():
        path = folder / f"motion{ending}"
        write_motion(motion, path)
        try:
            out[ending] = round_trip(humanoid, motion, read(path))
        except ModuleNotFoundError as error:
            raise InputError(path, "reader", f"{error.name} is missing: pip install 'egopose[dev]'") from None
    return out


def round_trip(humanoid: HumanoidModel, motion: Motion, back: ReadBack) -> dict[str, Any]:
    """The largest errors: ``position_mm``, ``rotation_deg``, ``force_n``, ``point_mm``, ``torque_nm``; ``contacts``.

    ``contacts`` is how many labels differ. What the format does not hold is None; ``fps`` is the error of the rate, and
    ``joints`` of how many joints positions came back. A pressure point counts where more than 1 N presses.
    """
    places, turns = _kinematics(humanoid, motion)
    names = list(motion.skeleton.names)
    known = {name: k for k, name in enumerate(names)}
    position = [
        float(1e3 * np.linalg.norm(values - places[:, known[name]], axis=-1).max())
        for name, values in back.positions.items()
        if name in known
    ]
    rotation = [_degrees(v, turns[:, names.index(k)]) for k, v in back.rotations.items() if k in names]
    dofs = [f"{j.name}_{k}" for j in motion.skeleton.joints for k in range(len(j.dofs))]
    rotation += [float(np.rad2deg(np.abs(v - motion.qpos[:, 7 + dofs.index(k)]).max())) for k, v in back.angles.items()]
    force: list[float] = []
    point: list[float] = []
    for body, values in back.forces.items():
        assert motion.ground_reaction is not None
        k = motion.ground_reaction.bodies.index(body)
        truth, presses = motion.ground_reaction.force[:, k], motion.ground_reaction.force[:, k, 2] > 1.0
        force.append(float(np.linalg.norm(values[:, :3] - truth, axis=1).max()))
        away = values[:, 3:6] - motion.ground_reaction.point[:, k]
        point.append(float(1e3 * np.linalg.norm(away[presses], axis=1).max(initial=0.0)))
    torque = None
    if back.torques is not None and motion.torques is not None:
        torque = float(np.abs(back.torques - motion.torques).max())
    return {
        "reader": back.reader,
        "joints": sum(k in names for k in back.positions),
        "fps": abs(back.fps - motion.fps),
        "position_mm": _largest(position),
        "rotation_deg": _largest(rotation),
        "force_n": _largest(force),
        "point_mm": _largest(point),
        "torque_nm": torque,
        "contacts": None if back.contacts is None else float((back.contacts != motion.contacts).sum()),
    }


def as_markdown(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table of docs/howto-export.md."""
    columns = ("position_mm", "rotation_deg", "force_n", "point_mm", "torque_nm", "contacts")
    heads = ("positions (mm)", "rotations (deg)", "forces (N)", "points (mm)", "torques (N m)", "contacts (wrong)")
    lines = [
        "| format | read by | joints | " + " | ".join(heads) + " |",
        "| --- | --- |" + " ---: |" * (1 + len(heads)),
    ]
    for ending, errors in found.items():
        cells = ["-" if errors[c] is None else f"{errors[c]:.1e}" if errors[c] else "0" for c in columns]
        lines.append(f"| `{ending}` | {errors['reader']} | {errors['joints']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _kinematics(humanoid: HumanoidModel, motion: Motion) -> tuple[Array, Array]:
    """World positions ``[T, J, 3]`` and rotations ``[T, J, 3, 3]`` by MuJoCo."""
    data = mujoco.MjData(humanoid.mj_model)
    places, turns = [], []
    for qpos in motion.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(humanoid.mj_model, data)
        places.append(data.xpos[humanoid.body_ids].copy())
        turns.append(data.xmat[humanoid.body_ids].reshape(-1, 3, 3).copy())
    return np.stack(places), np.stack(turns)


def _degrees(a: Array, b: Array) -> float:
    """The largest angle between rotation matrices ``[T, 3, 3]``, exact for small ones."""
    chord = np.linalg.norm(a - b, axis=(1, 2)).max() / np.sqrt(8.0)
    return float(np.rad2deg(2.0 * np.arcsin(min(chord, 1.0))))


def _largest(values: Sequence[float]) -> float | None:
    return float(max(values)) if values else None
