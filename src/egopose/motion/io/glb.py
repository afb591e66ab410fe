"""GLB (binary glTF 2.0): the skeleton as a skinned figure of bones with one animation; y up, metres, seconds.

glTF 2.0 specification, sections 3.7.3 (skins), 3.11 (animations) and 4 (the binary container). Contacts, torques and
forces of the ground have no place in glTF itself: they stand in accessors that the animation's ``extras`` name, which
other programs carry along or leave alone.

The container's two chunks are packed here and not by ``pygltflib`` (1.16.5): it would take the place of one method of
nine lines, as accessors, views, bounds and padding are its user's too, for 90 ms of import and five more packages. The
tests read what is written here with it.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import up_rotation
from egopose.motion.kinematics import forward_kinematics, joint_transforms
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: glTF is y up.
_WORLD = rot.conjugate(up_rotation("y"))
_FLOAT, _UINT, _USHORT, _UBYTE = 5126, 5125, 5123, 5121
_CODES = {"f4": _FLOAT, "u4": _UINT, "u2": _USHORT, "u1": _UBYTE}
_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942

#: A bone's figure: how far along it is widest, and its half width, as shares of its length; the half width at most, m.
_WAIST, _WIDTH, _WIDEST = 0.2, 0.12, 0.03


def write_glb(motion: Motion, path: str | Path) -> None:
    """Write a GLB: a node a joint (and a tip), a skinned mesh of bones, one animation with a keyframe a frame.

    The animation's ``extras`` hold ``fps`` and, where the motion has them, ``contacts`` (``names``, ``accessor``),
    ``torques`` (``names`` of the degrees of freedom as ``joint_k``; N m) and ``ground_reaction`` (``names``, ``force``,
    ``point``, ``moment``: accessors in N, m, N m, y up), each accessor flat in the order frame, name, component.
    """
    document = _Document()
    skeleton = motion.skeleton
    start = rot.rotate(_WORLD, motion.qpos[0, :3])
    nodes = _nodes(skeleton, start)
    joints = list(range(len(skeleton)))
    rest = skeleton.rest_qpos()
    rest[:3], rest[3:7] = start, _WORLD
    positions, quats = forward_kinematics(skeleton, rest)
    points, triangles, owners = _bones(skeleton, positions, quats)
    if len(points):
        weights = np.tile(np.array([1, 0, 0, 0], "<f4"), (len(points), 1))
        influences = np.zeros((len(points), 4), "<u2")
        influences[:, 0] = owners
        attributes = {
            "POSITION": document.add(points.astype("<f4"), bounds=True, target=34962),
            "JOINTS_0": document.add(influences, target=34962),
            "WEIGHTS_0": document.add(weights, target=34962),
        }
        indices = document.add(triangles.astype("<u4").reshape(-1), target=34963)
        primitive = {"attributes": attributes, "indices": indices, "material": 0}
        document.root["meshes"] = [{"name": "bones", "primitives": [primitive]}]
        document.root["materials"] = [
            {
                "name": "bones",
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorFactor": [0.26, 0.36, 0.58, 1.0], "metallicFactor": 0.0},
            }
        ]
        # Column-major, as glTF wants: the transpose of the matrix that multiplies columns.
        inverse = np.tile(np.eye(4), (len(skeleton), 1, 1))
        turns = rot.to_matrix(quats)
        inverse[:, :3, :3] = turns
        inverse[:, 3, :3] = -np.einsum("jk,jkl->jl", positions, turns)
        bind = document.add(inverse.astype("<f4"))
        document.root["skins"] = [{"joints": joints, "skeleton": 0, "inverseBindMatrices": bind}]
        nodes.append({"name": "bones", "mesh": 0, "skin": 0})
    document.root["nodes"] = nodes
    document.root["scenes"] = [{"nodes": [0, *([len(nodes) - 1] if len(points) else [])]}]
    document.root["animations"] = [_animation(motion, document)]
    Path(path).write_bytes(document.to_bytes())


class _Document:
    """A glTF tree under construction and its one buffer."""

    def __init__(self) -> None:
        self.root: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "egopose"},
            "scene": 0,
            "accessors": [],
            "bufferViews": [],
        }
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: np.ndarray, *, bounds: bool = False, target: int | None = None) -> int:
        """Index of a new accessor on little-endian ``values [n, ...]``; ``bounds`` states its least and greatest."""
        raw = np.ascontiguousarray(values).tobytes()
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(raw)}
        self.root["bufferViews"].append(view if target is None else {**view, "target": target})
        accessor: dict[str, Any] = {
            "bufferView": len(self.root["bufferViews"]) - 1,
            "componentType": _CODES[values.dtype.str[1:]],
            "count": len(values),
            "type": _TYPES[values.shape[1:]],
        }
        if bounds:
            accessor["min"] = np.atleast_1d(values.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(values.max(axis=0)).tolist()
        self.root["accessors"].append(accessor)
        raw += b"\0" * (-len(raw) % 4)
        self._parts.append(raw)
        self._size += len(raw)
        return len(self.root["accessors"]) - 1

    def to_bytes(self) -> bytes:
        """The binary container."""
        text = json.dumps({**self.root, "buffers": [{"byteLength": self._size}]}, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), _JSON_CHUNK) + text
        chunks += struct.pack("<II", self._size, _BINARY_CHUNK) + b"".join(self._parts)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _nodes(skeleton: Skeleton, start: Array) -> list[dict[str, Any]]:
    """Joints in the skeleton's order, then tips, at rest; the root stands where the motion starts."""
    nodes: list[dict[str, Any]] = []
    for i, joint in enumerate(skeleton.joints):
        place = start if i == 0 else np.array(joint.offset)
        nodes.append({"name": joint.name, "translation": place.tolist(), "children": skeleton.children(i)})
    nodes[0]["rotation"] = _xyzw(_WORLD).tolist()
    for i, joint in enumerate(skeleton.joints):
        for k, tip in enumerate(joint.tips):
            nodes[i]["children"].append(len(nodes))
            nodes.append({"name": f"{joint.name}_tip{k + 1 if k else ''}", "translation": list(tip)})
    for node in nodes:
        if not node.get("children", True):
            del node["children"]
    return nodes


def _animation(motion: Motion, document: _Document) -> dict[str, Any]:
    skeleton = motion.skeleton
    times = document.add((np.arange(len(motion)) / motion.fps).astype("<f4"), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def channel(node: int, path: str, values: Array) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "interpolation": "LINEAR", "output": document.add(values.astype("<f4"))})

    channel(0, "translation", rot.rotate(_WORLD, motion.qpos[:, :3]))
    channel(0, "rotation", _xyzw(rot.continuous(rot.multiply(_WORLD, rot.normalize(motion.qpos[:, 3:7])))))
    for i, joint in enumerate(skeleton.joints):
        if not joint.dofs:
            continue
        columns = skeleton.dof_slices[i]
        place, quat = joint_transforms(skeleton, i, motion.qpos[:, 7 + columns.start : 7 + columns.stop])
        if any(d.kind == "slide" for d in joint.dofs):
            channel(i, "translation", place + np.array(joint.offset))
        if any(d.kind == "hinge" for d in joint.dofs):
            channel(i, "rotation", _xyzw(rot.continuous(quat)))
    extras: dict[str, Any] = {"fps": motion.fps}
    if motion.contacts is not None:
        flat = document.add(np.asarray(motion.contacts, "<u1").reshape(-1))
        extras["contacts"] = {"names": list(motion.contact_names), "accessor": flat}
    if motion.torques is not None:
        names = [f"{j.name}_{k}" for j in skeleton.joints for k in range(len(j.dofs))]
        extras["torques"] = {"names": names, "accessor": document.add(motion.torques.astype("<f4").reshape(-1))}
    if motion.ground_reaction is not None:
        ground = motion.ground_reaction.turned(_WORLD)
        parts = {
            label: document.add(getattr(ground, label).astype("<f4").reshape(-1))
            for label in ("force", "point", "moment")
        }
        extras["ground_reaction"] = {"names": list(ground.bodies), **parts}
    return {"name": motion.name or "motion", "channels": channels, "samplers": samplers, "extras": extras}


def _bones(skeleton: Skeleton, positions: Array, quats: Array) -> tuple[Array, np.ndarray, np.ndarray]:
    """Points ``[V, 3]``, triangles ``[F, 3]`` and the joint ``[V]`` of octahedra from joints to children and tips."""
    points: list[Array] = []
    triangles: list[np.ndarray] = []
    owners: list[np.ndarray] = []
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]])
    for i, joint in enumerate(skeleton.joints):
        ends = [np.array(skeleton.joints[c].offset) for c in skeleton.children(i)] + [np.array(t) for t in joint.tips]
        for end in ends:
            length = float(np.linalg.norm(end))
            if length < 1e-6:
                continue
            turn = rot.to_matrix(rot.between(np.array([0.0, 0.0, 1.0]), end / length))
            half = min(_WIDTH * length, _WIDEST)
            waist = [[half, 0, 0], [0, half, 0], [-half, 0, 0], [0, -half, 0]]
            local = np.array([[0, 0, 0], *waist, [0, 0, length]]) + np.outer(
                [0, 1, 1, 1, 1, 0], [0, 0, _WAIST * length]
            )
            triangles.append(faces[:, ::-1] + 6 * len(points))
            points.append(positions[i] + rot.rotate(quats[i], local @ turn.T))
            owners.append(np.full(6, i))
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), int), np.empty(0, int)
    return np.concatenate(points), np.concatenate(triangles), np.concatenate(owners)


def _xyzw(quat: Array) -> Array:
    return quat[..., [1, 2, 3, 0]]
