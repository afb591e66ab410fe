"""Exported files read by other people's packages (the extra ``dev``): what is left of a motion in each format.

Nothing here uses the project's own readers or kinematics. Everything comes back z up, metres, N, N m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array

#: From y up to z up.
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class ReadBack:
    """What a reader found; absent where the format holds none.

    Attributes:
        reader: the package.
        fps: frames per second.
        positions: ``[T, 3]`` m by the joint's name.
        rotations: ``[T, 3, 3]`` in the world by the joint's name.
        angles: ``[T]`` rad by ``joint_k``.
        forces: ``[T, 9]`` by body: force N, point m, moment N m.
        torques: ``[T, D]`` N m.
        contacts: ``[T, K]``.
    """

    reader: str
    fps: float
    positions: Mapping[str, Array] = field(default_factory=dict)
    rotations: Mapping[str, Array] = field(default_factory=dict)
    angles: Mapping[str, Array] = field(default_factory=dict)
    forces: Mapping[str, Array] = field(default_factory=dict)
    torques: Array | None = None
    contacts: Array | None = None


def read_bvh(path: Path) -> ReadBack:
    """By upc-pymotion; cm, y up."""
    from pymotion.io.bvh import BVH
    from pymotion.ops.skeleton import fk

    file = BVH()
    file.load(str(path))
    quats, positions, parents, offsets, _, _ = file.get_data()
    points, turns = fk(quats, positions[:, 0], offsets, parents)
    names = list(file.data["names"])
    places = {name: 0.01 * points[:, k] @ _Z_UP.T for k, name in enumerate(names)}
    return ReadBack("upc-pymotion", 1 / file.data["frame_time"], places, _named(names, _Z_UP @ turns))


def read_glb(path: Path) -> ReadBack:
    """By pygltflib; the nodes' tree is walked with SciPy's rotations."""
    import pygltflib

    file = pygltflib.GLTF2().load_binary(str(path))
    blob = file.binary_blob()

    def numbers(index: int) -> np.ndarray:
        accessor = file.accessors[index]
        view = file.bufferViews[accessor.bufferView]
        kind = {5126: "<f4", 5121: "<u1"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        return np.frombuffer(blob, kind, accessor.count * width, view.byteOffset).reshape(accessor.count, width)

    animation = file.animations[0]
    frames = file.accessors[animation.samplers[0].input].count
    local = [np.tile(np.eye(4), (frames, 1, 1)) for _ in file.nodes]
    for node, matrix in zip(file.nodes, local, strict=True):
        matrix[:, :3, 3] = node.translation or [0, 0, 0]
        matrix[:, :3, :3] = Rotation.from_quat(node.rotation or [0, 0, 0, 1]).as_matrix()
    for channel in animation.channels:
        values = numbers(animation.samplers[channel.sampler].output)
        if channel.target.path == "translation":
            local[channel.target.node][:, :3, 3] = values
        else:
            local[channel.target.node][:, :3, :3] = Rotation.from_quat(values).as_matrix()
    world = {0: local[0]}
    waiting = [0]
    while waiting:
        parent = waiting.pop()
        for child in file.nodes[parent].children or []:
            world[child] = world[parent] @ local[child]
            waiting.append(child)
    joints = [(file.nodes[k].name, world[k]) for k in file.skins[0].joints]
    extras = animation.extras
    forces: dict[str, Array] = {}
    if "ground_reaction" in extras:
        names = extras["ground_reaction"]["names"]
        parts = [numbers(extras["ground_reaction"][part]) for part in ("force", "point", "moment")]
        turned = [part.reshape(frames, len(names), 3) @ _Z_UP.T for part in parts]
        forces = {name: np.concatenate([part[:, k] for part in turned], axis=1) for k, name in enumerate(names)}
    torques = numbers(extras["torques"]["accessor"]).reshape(frames, -1) if "torques" in extras else None
    contacts = numbers(extras["contacts"]["accessor"]).reshape(frames, -1) if "contacts" in extras else None
    return ReadBack(
        "pygltflib",
        1.0 / float(np.diff(numbers(animation.samplers[0].input)[:, 0].astype(float)).mean()),
        {name: matrix[:, :3, 3] @ _Z_UP.T for name, matrix in joints},
        {name: _Z_UP @ matrix[:, :3, :3] for name, matrix in joints},
        forces=forces,
        torques=torques,
        contacts=contacts,
    )


#: SMPL's 22 body joints as its papers list them, and the humanoid's joint that each stands for.
_SMPL = (
    ("Hips", -1), ("LeftUpLeg", 0), ("RightUpLeg", 0), ("Spine", 0), ("LeftLeg", 1), ("RightLeg", 2), ("Spine2", 3),
    ("LeftFoot", 4), ("RightFoot", 5), ("Spine3", 6), (None, 7), (None, 8), ("Neck", 9), ("LeftShoulder", 9),
    ("RightShoulder", 9), ("Head", 12), ("LeftArm", 13), ("RightArm", 14), ("LeftForeArm", 16), ("RightForeArm", 17),
    ("LeftHand", 18), ("RightHand", 19),
)  # fmt: skip


def read_amass(path: Path, pelvis: Sequence[float]) -> ReadBack:
    """By NumPy and SciPy; ``pelvis`` (m, y up) is where the body model's pelvis rests. Only the root has a place."""
    file = np.load(path, allow_pickle=False)
    # SMPL's axes x left, y up, z forward are the humanoid's y, z, x.
    axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    world: list[Array] = []
    rotations = {}
    for k, (name, parent) in enumerate(_SMPL):
        local = Rotation.from_rotvec(file["poses"][:, 3 * k : 3 * k + 3]).as_matrix()
        world.append(world[parent] @ local if parent >= 0 else local)
        if name is not None:
            rotations[name] = world[k] @ axes.T
    return ReadBack("numpy", float(file["mocap_framerate"]), {"Hips": file["trans"] + np.array(pelvis)}, rotations)


def read_trc(path: Path) -> ReadBack:
    """By trc-data-reader; mm, y up."""
    from trc import TRCData

    file = TRCData()
    file.load(str(path))
    places = {name: 0.001 * np.array(file[name], dtype=float) @ _Z_UP.T for name in file["Markers"]}
    return ReadBack("trc-data-reader", float(file["DataRate"]), places)


def read_c3d(path: Path) -> ReadBack:
    """Points, contacts and torques by c3d, platforms by ezc3d (from another language and authors); mm, z up."""
    import c3d
    import ezc3d

    with path.open("rb") as stream:
        file = c3d.Reader(stream)
        names = [name.strip() for name in file.point_labels]
        channels = [name.strip() for name in file.analog_labels]
        rows = [(points[:, :3].copy(), analog[:, 0].copy()) for _, points, analog in file.read_frames()]
        rate = float(file.point_rate)
    points, analog = 0.001 * np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows])
    contact = [k for k, name in enumerate(channels) if name.endswith("_contact")]
    torque = [k for k, name in enumerate(channels) if name.endswith("_torque")]
    forces = {}
    bodies = [name.removesuffix("_Fx") for name in channels if name.endswith("_Fx")]
    if bodies:
        platforms = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"]
        for body, platform in zip(bodies, platforms, strict=True):
            parts = (platform["force"], 0.001 * platform["center_of_pressure"], 0.001 * platform["Tz"])
            forces[body] = np.nan_to_num(np.concatenate(parts).T)
    return ReadBack(
        "c3d, ezc3d",
        rate,
        {name: points[:, k] for k, name in enumerate(names)},
        forces=forces,
        torques=analog[:, torque] if torque else None,
        contacts=analog[:, contact] if contact else None,
    )


def read_mot(path: Path) -> ReadBack:
    """By NumPy: angles, the root's rotation and place."""
    table, rate = _storage(path)
    columns = [table[f"pelvis_{part}"] for part in ("tilt", "list", "rotation")]
    turn = Rotation.from_euler("ZXY", np.stack(columns, axis=1), degrees=True).as_matrix()
    place = np.stack([table[f"pelvis_t{axis}"] for axis in "xyz"], axis=1) @ _Z_UP.T
    angles = {name: np.deg2rad(v) for name, v in table.items() if not name.startswith("pelvis_") and name != "time"}
    return ReadBack("numpy", rate, {"Hips": place}, {"Hips": _Z_UP @ turn @ _Z_UP.T}, angles)


def read_forces_mot(path: Path) -> ReadBack:
    """By NumPy: forces of the ground."""
    table, rate = _storage(path)
    forces = {}
    for body in [name.removesuffix("_ground_force_vx") for name in table if name.endswith("_ground_force_vx")]:
        parts = [
            np.stack([table[f"{body}_ground_{part}{axis}"] for axis in "xyz"], axis=1) @ _Z_UP.T
            for part in ("force_v", "force_p", "torque_")
        ]
        forces[body] = np.concatenate(parts, axis=1)
    return ReadBack("numpy", rate, forces=forces)


def read_torques_sto(path: Path) -> ReadBack:
    """By NumPy: joint torques."""
    table, rate = _storage(path)
    return ReadBack("numpy", rate, torques=np.stack([v for name, v in table.items() if name != "time"], axis=1))


def read_csv(path: Path) -> ReadBack:
    """By NumPy: everything in the table; the rate from its times."""
    with path.open() as stream:
        names = next(line for line in stream if not line.startswith("#")).strip().split(",")
    table = dict(zip(names, np.loadtxt(path, delimiter=",", comments="#", skiprows=5).T, strict=True))

    def vectors(tail: str) -> dict[str, Array]:
        heads = [name.removesuffix(tail.format("x")) for name in names if name.endswith(tail.format("x"))]
        return {head: np.stack([table[head + tail.format(axis)] for axis in "xyz"], axis=1) for head in heads}

    grounds = [vectors(f" ground {part}") for part in ("force {} [N]", "point {} [m]", "moment {} [N m]")]
    places = {name: value for name, value in vectors(" {} [m]").items() if not name.endswith("point")}
    quats = np.stack([table[f"root q{axis}"] for axis in "xyzw"], axis=1)
    contact = [v for name, v in table.items() if name.endswith(" contact")]
    torque = [v for name, v in table.items() if " torque [" in name]
    return ReadBack(
        "numpy",
        1.0 / float(np.diff(table["time [s]"]).mean()),
        places,
        {"Hips": Rotation.from_quat(quats).as_matrix()},
        {name.removesuffix(" [rad]"): v for name, v in table.items() if name.endswith(" [rad]")},
        {body: np.concatenate([part[body] for part in grounds], axis=1) for body in grounds[0]},
        np.stack(torque, axis=1) if torque else None,
        np.stack(contact, axis=1) if contact else None,
    )


def readers(pelvis: Sequence[float]) -> dict[str, Callable[[Path], ReadBack]]:
    """A reader an ending; ``pelvis`` see :func:`read_amass`."""
    return {
        ".bvh": read_bvh,
        ".glb": read_glb,
        ".amass.npz": lambda path: read_amass(path, pelvis),
        ".trc": read_trc,
        ".c3d": read_c3d,
        ".mot": read_mot,
        ".forces.mot": read_forces_mot,
        ".torques.sto": read_torques_sto,
        ".csv": read_csv,
    }


def _storage(path: Path) -> tuple[dict[str, Array], float]:
    """Columns by name of an OpenSim storage file, and its rate."""
    lines = path.read_text().splitlines()
    start = lines.index("endheader") + 1
    header = dict(line.split("=", 1) for line in lines[: start - 1] if "=" in line)
    values = np.array([line.split("\t") for line in lines[start + 1 :]], dtype=float)
    if values.shape != (int(header["nRows"]), int(header["nColumns"])):
        raise ValueError(f"{path}: the header says {header}, the table is {values.shape}")
    names = lines[start].split("\t")
    return dict(zip(names, values.T, strict=True)), 1.0 / float(np.diff(values[:, 0]).mean())


def _named(names: list[str], turns: Any) -> dict[str, Array]:
    return {name: turns[:, k] for k, name in enumerate(names)}
