"""The project's own clip: an ``.npz`` with a JSON header and plain arrays, exact to the bit, no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.io._files import MAX_JOINTS
from egopose.motion.io._npz import read_arrays
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Dof, Joint, Skeleton

#: Bytes of the header: 2048 joints take 400 kB, ``meta`` a few. As Python objects it takes up to forty times as much.
_MAX_HEADER = 8 * 2**20

#: No coordinate (m, rad) and no torque (N m) of a person is larger.
_MAX_VALUE = 1e7

#: Three slides and three hinges, as the project's own readers make them at most; tips beyond any mesh's.
_MAX_DOFS, _MAX_TIPS = 6, 256

_GROUND = ("force", "point", "moment")

FORMAT, VERSION = "egopose.motion", 1


def write_native(motion: Motion, path: str | Path, *, dtype: str = "float64") -> None:
    """Write a clip; ``dtype="float32"`` halves it at about 1e-7 of each value.

    Arrays: ``header`` (UTF-8 JSON as uint8: format, version, name, fps, skeleton, contact names, names of the bodies
    on the ground, meta), ``qpos [T, nq]``, and ``contacts [T, k]``, ``torques [T, nv - 6]``, ``ground_force``,
    ``ground_point``, ``ground_moment [T, b, 3]``, ``confidence [T]`` where the motion has them.

    Raises:
        ValueError: another ``dtype``, or ``meta`` that JSON cannot say.
    """
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype must be float32 or float64, got {dtype!r}")
    header = {
        "format": FORMAT,
        "version": VERSION,
        "name": motion.name,
        "fps": motion.fps,
        "skeleton": skeleton_to_json(motion.skeleton),
        "contact_names": list(motion.contact_names),
        "ground_bodies": [] if motion.ground_reaction is None else list(motion.ground_reaction.bodies),
        "meta": motion.meta,
    }
    try:
        text = json.dumps(header, allow_nan=False)
    except TypeError as error:
        raise ValueError(f"meta holds what JSON cannot say: {error}") from error
    arrays = {"header": np.frombuffer(text.encode(), dtype=np.uint8), "qpos": motion.qpos.astype(dtype)}
    if motion.contacts is not None:
        arrays["contacts"] = np.asarray(motion.contacts, dtype=bool)
    if motion.torques is not None:
        arrays["torques"] = np.asarray(motion.torques, dtype=dtype)
    if motion.confidence is not None:
        arrays["confidence"] = np.asarray(motion.confidence, dtype=dtype)
    if motion.ground_reaction is not None:
        for label in _GROUND:
            arrays[f"ground_{label}"] = getattr(motion.ground_reaction, label).astype(dtype)
    with Path(path).open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]  # the stub takes allow_pickle for an array


def read_native(path: str | Path) -> Motion:
    """Read a clip written by :func:`write_native`.

    Raises:
        InputError: names the file, the field of the header or the array, and the cause.
    """
    path = Path(path)
    ground = tuple(f"ground_{label}" for label in _GROUND)
    arrays = read_arrays(path, ("header", "qpos", "contacts", "torques", "confidence", *ground))
    if "header" not in arrays or arrays["header"].dtype != np.uint8 or arrays["header"].ndim != 1:
        raise InputError(path, "header", "missing or not bytes: not a clip of this project")
    if len(arrays["header"]) > _MAX_HEADER:
        raise InputError(path, "header", f"{len(arrays['header'])} bytes; at most {_MAX_HEADER} are read")
    try:
        header = json.loads(arrays["header"].tobytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(path, "header", f"not JSON: {error}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(path, "header.format", f"is not {FORMAT!r}")
    if header.get("version") != VERSION:
        raise InputError(path, "header.version", f"{header.get('version')!r:.40}; this program reads {VERSION}")
    qpos = arrays.get("qpos")
    if qpos is None or qpos.dtype not in (np.float32, np.float64):
        raise InputError(path, "qpos", "missing or not float32 or float64")
    expected = {"contacts": ("b", 2), "torques": ("f", 2), "confidence": ("f", 1), **dict.fromkeys(ground, ("f", 3))}
    for label, (kind, axes) in expected.items():
        if label in arrays and (arrays[label].dtype.kind != kind or arrays[label].ndim != axes):
            raise InputError(path, label, f"wrong type or shape: {arrays[label].dtype} {arrays[label].shape}")
    skeleton = _checked(path, "header.skeleton", lambda: skeleton_from_json(header["skeleton"]))
    if "torques" in arrays and arrays["torques"].shape[1] != skeleton.n_dofs:
        raise InputError(
            path, "torques", f"{arrays['torques'].shape[1]} columns for {skeleton.n_dofs} degrees of freedom"
        )
    for label in sorted({"qpos", "torques", "confidence", *ground} & set(arrays)):
        bad = ~(np.abs(arrays[label]) < _MAX_VALUE).reshape(len(arrays[label]), -1).all(axis=1)
        if bad.any():
            raise InputError(path, label, f"frame {int(np.argmax(bad))} is not finite or absurdly large")
    if qpos.ndim == 2 and qpos.shape[1] >= 7 and (np.linalg.norm(qpos[:, 3:7], axis=1) < 0.1).any():
        raise InputError(path, "qpos", "the root's quaternion is shorter than 0.1")
    fps = header.get("fps")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 1e-3 <= fps <= 1e5:
        raise InputError(path, "header.fps", f"{fps!r:.40} is not a frame rate")
    meta = header.get("meta", {})
    if not isinstance(meta, dict):
        raise InputError(path, "header.meta", "is not an object")
    torques, confidence = arrays.get("torques"), arrays.get("confidence")
    return _checked(
        path,
        "qpos",
        lambda: Motion(
            skeleton,
            qpos,
            float(fps),
            name=str(header["name"]),
            contacts=arrays.get("contacts"),
            contact_names=tuple(str(n) for n in header["contact_names"]),
            torques=None if torques is None else torques.astype(np.float64),
            ground_reaction=_ground_reaction(arrays, header),
            confidence=None if confidence is None else confidence.astype(np.float64),
            meta=meta,
        ),
    )


def _ground_reaction(arrays: dict[str, np.ndarray], header: dict[str, Any]) -> GroundReaction | None:
    """Raises ValueError where an array is missing or of another shape."""
    there = [f"ground_{label}" for label in _GROUND if f"ground_{label}" in arrays]
    if not there:
        return None
    if len(there) < len(_GROUND):
        raise ValueError(f"of the ground's arrays only {', '.join(there)} are there")
    bodies = tuple(str(name) for name in header["ground_bodies"])
    return GroundReaction(bodies, *(arrays[name] for name in there))


def skeleton_to_json(skeleton: Skeleton) -> dict[str, Any]:
    """The skeleton as JSON values; :func:`skeleton_from_json` turns it back, equal."""
    joints = [
        {
            "name": j.name,
            "parent": j.parent,
            "offset": list(j.offset),
            "dofs": [[d.kind, *d.axis] for d in j.dofs],
            "tips": [list(t) for t in j.tips],
        }
        for j in skeleton.joints
    ]
    return {"name": skeleton.name, "joints": joints}


def skeleton_from_json(value: Any) -> Skeleton:
    """Raises KeyError, TypeError or ValueError on what is no skeleton."""
    if len(value["joints"]) > MAX_JOINTS:
        raise ValueError(f"{len(value['joints'])} joints; at most {MAX_JOINTS}")
    for joint in value["joints"]:
        if len(joint["dofs"]) > _MAX_DOFS or len(joint["tips"]) > _MAX_TIPS:
            raise ValueError(f"joint {joint['name']!r:.40} has more than {_MAX_DOFS} dofs or {_MAX_TIPS} tips")
    joints = tuple(
        Joint(
            str(j["name"]),
            int(j["parent"]),
            _vector(j["offset"]),
            tuple(_dof(d) for d in j["dofs"]),
            tuple(_vector(t) for t in j["tips"]),
        )
        for j in value["joints"]
    )
    return Skeleton(joints, name=str(value["name"]))


def _dof(value: Any) -> Dof:
    kind, *axis = value
    vector = _vector(axis)
    if kind not in ("hinge", "slide") or abs(np.linalg.norm(vector) - 1.0) > 1e-6:
        raise ValueError(f"degree of freedom {value!r:.80} is no hinge or slide with a unit axis")
    return Dof(kind, vector)


def _vector(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in value)
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"vector {value!r:.80} is not finite")
    return x, y, z


def _checked(path: Path, field: str, make: Any) -> Any:
    """What ``make`` gives; its complaints about values become an InputError on ``field``."""
    try:
        return make()
    except KeyError as error:
        raise InputError(path, field, f"key {error} is missing") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(path, field, " ".join(str(error).split())[:200]) from error
