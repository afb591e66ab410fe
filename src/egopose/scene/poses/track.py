"""One person's keypoints over the frames of a clip."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.motion.io._npz import read_arrays
from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import BODY_25, SCHEMAS, KeypointSchema, converted

Mask = NDArray[np.bool_]

#: Axes of 3D keypoints: the camera's (x right, y down, z ahead) or the world's (z up).
AXES = ("camera", "world")
#: The most frames: over an hour at 60 frames/s.
MAX_FRAMES = 2**18
_ARRAYS = ("pixels", "confidence", "positions", "filled", "swapped", "weights")


@dataclass(frozen=True)
class PoseTrack:
    """Keypoints of the one person that is followed.

    Args:
        schema: the layout of the ``K`` keypoints.
        pixels: ``[T, K, 2]`` px, x right and y down from the picture's upper left corner; NaN where unknown.
        confidence: ``[T, K]`` from 0 to 1; 0 where neither pixels nor positions are known.
        fps: frames per second.
        image_size: width and height, px; None for a source without pictures.
        positions: ``[T, K, 3]`` m, NaN where unknown, or None. A camera's are relative to the middle of the hips.
        axes: of ``positions``, one of :data:`AXES`.
        filled: ``[T, K]``: interpolated, not seen.
        swapped: ``[T]``: left and right were exchanged, and have been put right.
        weights: ``[T]`` how much a frame counts: 1 for what was estimated, less for keyframes made by hand.
        person: which one of the source's people.
        notes: what was found and mended, one sentence each.

    Raises:
        ValueError: shapes that do not agree, confidences outside 0 to 1, a rate that is not positive.
    """

    schema: KeypointSchema
    pixels: Array
    confidence: Array
    fps: float
    image_size: tuple[int, int] | None = None
    positions: Array | None = None
    axes: str = "camera"
    filled: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    swapped: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))
    weights: Array = field(default_factory=lambda: np.zeros(0))
    person: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frames, count = len(self.pixels), len(self.schema)
        defaults = {
            "filled": np.zeros((frames, count), dtype=bool),
            "swapped": np.zeros(frames, dtype=bool),
            "weights": np.ones(frames),
        }
        for name, value in defaults.items():
            if not getattr(self, name).size:
                object.__setattr__(self, name, value)
        shapes = {"pixels": (frames, count, 2), "confidence": (frames, count), "filled": (frames, count)}
        shapes |= {"swapped": (frames,), "weights": (frames,)}
        if self.positions is not None:
            shapes["positions"] = (frames, count, 3)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must be {list(shape)}, got {list(getattr(self, name).shape)}")
        if not frames or not self.fps > 0:
            raise ValueError(f"a track needs a frame and a rate, got {frames} frames at {self.fps}")
        if not ((self.confidence >= 0) & (self.confidence <= 1)).all():
            raise ValueError("confidence must lie between 0 and 1")
        if self.axes not in AXES:
            raise ValueError(f"axes must be one of {', '.join(AXES)}, got {self.axes!r}")

    def __len__(self) -> int:
        return len(self.pixels)

    def to_schema(self, schema: KeypointSchema = BODY_25) -> PoseTrack:
        """The same poses in another layout, see :func:`~egopose.scene.poses.keypoints.converted`."""
        if schema == self.schema:
            return self
        pixels, confidence = converted(self.pixels, self.confidence, self.schema, schema)
        positions = None
        if self.positions is not None:
            positions = converted(self.positions, self.confidence, self.schema, schema)[0]
        marks = converted(self.filled[..., None].astype(float), self.confidence, self.schema, schema)[0]
        filled = np.nan_to_num(marks[..., 0]) > 0
        return replace(self, schema=schema, pixels=pixels, confidence=confidence, positions=positions, filled=filled)

    def boxes(self, margin: float = 0.15, sure: float = 0.3) -> Array:
        """``[T, 4]`` px (left, top, right, bottom) around the person; NaN in frames without one.

        Args:
            margin: added on all sides, as a share of the box's longer side: keypoints lie inside the body.
            sure: keypoints below this confidence are left out.
        """
        seen = (self.confidence >= sure) & np.isfinite(self.pixels).all(axis=-1)
        low = np.where(seen[..., None], self.pixels, np.inf).min(axis=1)
        high = np.where(seen[..., None], self.pixels, -np.inf).max(axis=1)
        pad = margin * (high - low).max(axis=1, keepdims=True)
        boxes = np.concatenate([low - pad, high + pad], axis=1)
        boxes[seen.sum(axis=1) < 2] = np.nan
        return boxes

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` of plain arrays that :func:`load_track` reads."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
        size = np.array(self.image_size if self.image_size is not None else (0, 0))
        layout = np.frombuffer(self.schema.name.encode(), dtype=np.uint8)
        notes = np.frombuffer("\n".join((self.person, *self.notes)).encode(), dtype=np.uint8)
        arrays |= {"fps": np.array(self.fps), "image_size": size, "axes": np.array(AXES.index(self.axes))}
        with Path(path).open("wb") as stream:
            np.savez_compressed(stream, **arrays, pose_layout=layout, notes=notes)


def load_track(path: str | Path) -> PoseTrack:
    """Read what :meth:`PoseTrack.save` wrote.

    Raises:
        InputError: an array missing, of another shape or kind, an unknown layout.
    """
    path = Path(path)
    arrays = read_arrays(path, (*_ARRAYS, "fps", "image_size", "axes", "pose_layout", "notes"))
    for name in ("pixels", "confidence", "fps", "pose_layout"):
        if name not in arrays:
            raise InputError(path, name, "missing: this is no track of poses")
    layout = arrays["pose_layout"].tobytes().decode(errors="replace")
    if layout not in SCHEMAS:
        raise InputError(path, "pose_layout", f"{layout[:40]!r} is not known; there are {', '.join(SCHEMAS)}")
    person, *notes = arrays["notes"].tobytes().decode(errors="replace").split("\n") if "notes" in arrays else [""]
    try:
        width, height = (int(v) for v in arrays.get("image_size", np.zeros(2)))
        return PoseTrack(
            SCHEMAS[layout],
            arrays["pixels"].astype(np.float64),
            arrays["confidence"].astype(np.float64),
            float(arrays["fps"]),
            (width, height) if width else None,
            arrays["positions"].astype(np.float64) if "positions" in arrays else None,
            AXES[int(arrays.get("axes", np.zeros(())))],
            arrays["filled"].astype(bool),
            arrays["swapped"].astype(bool),
            arrays["weights"].astype(np.float64),
            person,
            tuple(notes),
        )
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(path, "arrays", f"do not make a track of poses: {error}"[:200]) from None
