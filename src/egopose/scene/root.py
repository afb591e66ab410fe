"""Where a body is in the world, from poses relative to its pelvis and from its contacts, before any physics.

Feet that touch something stay where they are, and carry the body. In flight the centre of mass falls as gravity has
it. Everything is one linear least-squares problem over the clip. World: z up, m. It is the start of the reconstruction
with physics, and its baseline.

Where the camera stays in its place, the pictures also tell how the pelvis moves across the line of sight. That decides
what happens while no foot touches anything, such as how far a body falls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation

from egopose.motion.contacts import runs_of
from egopose.motion.rotations import Array

GRAVITY = 9.81


@dataclass(frozen=True)
class RootSettings:
    """Scales of the residuals: what counts as much as what.

    Args:
        slip: m/s, of a foot that stands firmly.
        settling: s after a contact's beginning, and before its end, in which a foot does not yet stand firmly.
        guessed: firmness of a foot that must stand though no contact is known, 0 to 1.
        flight: m/s^2, of what the centre of mass's acceleration in flight differs from gravity by.
        sway: m/s^2, of the centre of mass's acceleration on the feet; it only fills what feet leave open.
        landing: m/s^2, of that just before and after a flight: people land with ten times their weight.
        level: m: supports whose heights differ by less are one level, where one foot stands while the other lands.
        level_in_flight: m: likewise after a flight, whose height is known less well.
        sole: m: that a standing sole's joints are off their support.
        lowness: m: of a foot's points, those that much higher than the lowest hardly count.
        ballistic: least share of a time without contact that take-off and landing speeds must tell of, to be a flight.
        seen: m, of the pelvis's place across the line of sight: keypoints are off by 1 to 3 % of the body.
        seen_depth: of its depth, in shares of the depth: so far is the person's size in the picture off.
        moving: m/s: both feet are seen to move faster through most of a flight.
        fall: least share of gravity by which the pelvis is seen to accelerate downwards in a flight.
        fall_frames: fewest steps from which that is told: a speed is known to 0.3 m/s in each.
    """

    slip: float = 0.02
    settling: float = 0.1
    guessed: float = 0.05
    flight: float = 0.5
    sway: float = 5.0
    landing: float = 100.0
    level: float = 0.08
    level_in_flight: float = 0.15
    sole: float = 0.01
    lowness: float = 0.02
    ballistic: float = 0.2
    seen: float = 0.04
    seen_depth: float = 0.04
    moving: float = 0.6
    fall: float = 0.5
    fall_frames: int = 8


@dataclass(frozen=True)
class Support:
    """A foot that stands: frames ``start .. stop - 1`` and the height of what it stands on, m."""

    foot: int
    start: int
    stop: int
    height: float


@dataclass(frozen=True)
class KinematicRoot:
    """Where the pelvis is.

    Args:
        positions: ``[T, 3]`` m of the pelvis.
        supports: in order of time.
        flight: ``[T]`` whether the body flies.
        camera: ``[3]`` m, the camera's place; empty where pictures tell nothing.
        misfit: sum of the squared residuals: how ill feet, gravity and pictures go together.
    """

    positions: Array
    supports: tuple[Support, ...]
    flight: NDArray[np.bool_]
    camera: Array
    misfit: float


@dataclass(frozen=True)
class SeenPlaces:
    """Where pictures tell that the pelvis is, of a camera that stays in one place.

    Args:
        places: ``[T, 3]`` m, from the camera, in axes of the world.
        axes: ``[T, 3, 3]`` unit vectors of the world: two across the line of sight, the last along it.
        depth: ``[T]`` m, from the camera.
    """

    places: Array
    axes: Array
    depth: Array

    def steps(self) -> tuple[Array, Array]:
        """Across the line of sight, from each frame to the next: unit vectors ``[T - 1, 2, 3]``, m ``[T - 1, 2]``."""
        axes = 0.5 * (self.axes[1:] + self.axes[:-1])[:, :2]
        axes = axes / np.linalg.norm(axes, axis=2, keepdims=True)
        return axes, np.einsum("tij,tj->ti", axes, np.diff(self.places, axis=0))


def kinematic_root(
    feet: Array,
    contacts: np.ndarray,
    center_of_mass: Array,
    fps: float,
    settings: RootSettings | None = None,
    seen: SeenPlaces | None = None,
) -> KinematicRoot:
    """The pelvis's way through the world.

    Args:
        feet: ``[T, F, P, 3]`` m, relative to the pelvis, z up: P points on each foot's sole (heel, ball). The lowest
            of them stands.
        contacts: ``[T, F]`` whether the foot touches something.
        center_of_mass: ``[T, 3]`` m, relative to the pelvis.
        fps: frames per second.
        settings: see :class:`RootSettings`.
        seen: of a camera that stays in its place; None where pictures tell nothing.

    Returns:
        See :class:`KinematicRoot`. The first support's height is 0 and the pelvis starts at x = y = 0.

    Raises:
        ValueError: shapes do not agree, a value is not finite, or no foot ever touches anything.
    """
    settings = settings or RootSettings()
    feet, center_of_mass = np.asarray(feet, dtype=np.float64), np.asarray(center_of_mass, dtype=np.float64)
    contacts = np.asarray(contacts, dtype=bool)
    if feet.ndim != 4 or feet.shape[3] != 3 or contacts.shape != feet.shape[:2]:
        raise ValueError(f"feet must be [T, F, P, 3], contacts [T, F]: {list(feet.shape)}, {list(contacts.shape)}")
    if center_of_mass.shape != (len(feet), 3):
        raise ValueError(f"center_of_mass must be [{len(feet)}, 3], got {list(center_of_mass.shape)}")
    if not (np.isfinite(feet).all() and np.isfinite(center_of_mass).all()):
        raise ValueError("feet and center_of_mass must be finite")
    if not contacts.any():
        raise ValueError("no foot ever touches anything: there is nothing to stand on")
    # The point that carries moves from heel to ball: its velocity is the mean of the low points' velocities.
    share = np.exp(-(feet[..., 2] - feet[..., 2].min(axis=2, keepdims=True)) / settings.lowness)
    share /= share.sum(axis=2, keepdims=True)
    between = 0.5 * (share[1:] + share[:-1])
    steps = (np.diff(feet, axis=0) * (between / between.sum(axis=2, keepdims=True))[..., None]).sum(axis=2)
    if seen is not None and (seen.axes.shape, seen.places.shape) != ((len(feet), 3, 3), (len(feet), 3)):
        raise ValueError(f"seen must be of {len(feet)} frames: {list(seen.axes.shape)}, {list(seen.places.shape)}")
    moving = _moving(steps, seen, fps, settings)
    firmness, flight = _firmness(contacts, feet, steps, center_of_mass, moving, seen, fps, settings)
    positions, camera, misfit = _least_squares(steps, firmness, flight, center_of_mass, seen, fps, settings)
    lowest = positions[:, None, 2] + feet[..., 2].min(axis=2)
    supports = _levelled(lowest, contacts, settings)
    root = KinematicRoot(positions, supports, flight, camera, misfit)
    root = on_supports(root, feet, center_of_mass, fps, settings, seen)
    start = np.array([*root.positions[0, :2], 0.0])
    return replace(root, positions=root.positions - start, camera=camera - start if len(camera) else camera)


def on_supports(
    root: KinematicRoot,
    feet: Array,
    center_of_mass: Array,
    fps: float,
    settings: RootSettings,
    seen: SeenPlaces | None = None,
) -> KinematicRoot:
    """The root with the heights solved again, so that feet stand at their supports' heights.

    Args:
        root: its supports may have got other heights than :func:`kinematic_root` gave them.
        feet, center_of_mass, fps, settings, seen: as there.
    """
    positions, frames = root.positions, len(root.positions)
    lowest = positions[:, None, 2] + feet[..., 2].min(axis=2)
    weight, wanted = np.zeros(frames), np.zeros(frames)
    for support in root.supports:
        span = slice(support.start, support.stop)
        weight[span] += 1.0
        wanted[span] += support.height - (lowest[span, support.foot] - positions[span, 2])
    bend, target = _bending(root.flight, center_of_mass, fps, settings)
    stand = weight / settings.sole**2
    normal = bend.T @ bend + sparse.diags_array(stand) + 1e-9 * sparse.eye_array(frames)
    right = bend.T @ target[:, 2] + stand * wanted / np.maximum(weight, 1.0)
    if seen is not None and len(root.camera):
        factor, value = _seen_heights(seen, positions, root.camera, settings)
        normal = normal + sparse.diags_array((factor**2).sum(axis=1))
        right = right + (factor * value).sum(axis=1)
    out = positions.copy()
    out[:, 2] = sparse.linalg.spsolve(normal.tocsc(), right)
    return replace(root, positions=out)


def _moving(steps: Array, seen: SeenPlaces | None, fps: float, settings: RootSettings) -> NDArray[np.bool_]:
    """``[T - 1]`` steps in which every foot is seen to move; ``steps [T - 1, F, 3]`` m are the feet's."""
    if seen is None:
        return np.zeros(len(steps), dtype=bool)
    axes, told = seen.steps()
    across = told[:, None] + np.einsum("tij,tfj->tfi", axes, steps)
    return np.asarray((np.linalg.norm(across, axis=2) * fps > settings.moving).all(axis=1))


def _firmness(
    contacts: np.ndarray,
    feet: Array,
    steps: Array,
    center_of_mass: Array,
    moving: NDArray[np.bool_],
    seen: SeenPlaces | None,
    fps: float,
    settings: RootSettings,
) -> tuple[Array, NDArray[np.bool_]]:
    """How firmly each foot stands ``[T, F]``, 0 to 1, and which frames ``[T]`` are in flight.

    A body that leaves with vertical speed u and lands with w has flown for (u - w) / g. Contacts are known to a few
    frames only, so the flight is that long in the middle of the time without contact. In a step without contact the
    body sinks and then rises: u < w. There the lower foot must stand, unless both are seen to move.
    """
    out = np.zeros(contacts.shape)
    frames = len(contacts)
    for foot in range(contacts.shape[1]):
        for start, stop in runs_of(contacts[:, foot]):
            inside = np.arange(start, stop)
            # The clip's ends cut contacts off: those edges are none.
            after = inside - start + 1 if start > 0 else np.full(stop - start, frames)
            before = stop - inside if stop < frames else np.full(stop - start, frames)
            out[start:stop, foot] = np.minimum(1.0, np.minimum(after, before) / (settings.settling * fps)) ** 2
    lower = feet[..., 2].min(axis=2).argmin(axis=1)
    flight = np.zeros(frames, dtype=bool)
    for start, stop in runs_of(np.asarray(~contacts.any(axis=1))):
        told = 0.0
        if start > 0 and stop < frames:
            left, landed = (_rise(steps, contacts, center_of_mass, frame, fps) for frame in (start - 1, stop))
            told = (left - landed) / GRAVITY * fps
        if _seen_to_fly(seen, start, stop, fps, moving, settings):
            flight[start:stop] = True
        elif told >= settings.ballistic * (stop - start):
            spare = int(max(0.0, (stop - start - told) / 2))
            flight[start + spare : stop - spare] = True
        else:
            out[np.arange(start, stop), lower[start:stop]] = settings.guessed
    return out, flight


def _seen_to_fly(
    seen: SeenPlaces | None, start: int, stop: int, fps: float, moving: NDArray[np.bool_], settings: RootSettings
) -> bool:
    """Whether pictures show a flight in frames ``start .. stop - 1``: both feet move, and the pelvis falls freely.

    Falling is told by the pelvis's seen acceleration along gravity, where there are frames enough to tell it.
    """
    if seen is None or np.mean(moving[max(start - 1, 0) : stop]) <= 0.5:
        return False
    all_axes, told = seen.steps()
    axes, speeds = all_axes[start : stop - 1, :, 2], told[start : stop - 1] * fps
    if len(axes) < settings.fall_frames:
        return True
    # The picture's own axis that is nearest to the vertical tells most.
    row = int(np.abs(axes).mean(axis=0).argmax())
    pull = float(np.polyfit(np.arange(len(speeds)) / fps, speeds[:, row], 1)[0])
    return pull * float(np.sign(axes[:, row].mean())) < -settings.fall * GRAVITY


def _rise(steps: Array, contacts: np.ndarray, center_of_mass: Array, frame: int, fps: float) -> float:
    """Vertical speed (m/s) of the centre of mass over the foot that stands at ``frame``, by the two steps around it."""
    foot = int(np.argmax(contacts[frame]))
    around = [t for t in (frame - 1, frame) if 0 <= t < len(steps) and contacts[t : t + 2, foot].all()]
    around = around or [min(max(frame - 1, 0), len(steps) - 1)]
    moves = [center_of_mass[t + 1, 2] - center_of_mass[t, 2] - steps[t, foot, 2] for t in around]
    return float(np.mean(moves)) * fps


def _least_squares(
    steps: Array,
    firmness: Array,
    flight: NDArray[np.bool_],
    center_of_mass: Array,
    seen: SeenPlaces | None,
    fps: float,
    settings: RootSettings,
) -> tuple[Array, Array, float]:
    """The pelvis ``[T, 3]`` m, from 0 on: standing feet slip least, and flights are nearest to gravity's.

    Also the camera's place ``[3]``, empty where pictures tell nothing, and the sum of the squared residuals.
    """
    frames = len(firmness)
    if frames < 2:
        return np.zeros((frames, 3)), np.zeros(3), 0.0
    change = sparse.eye_array(frames, k=1, format="csr")[: frames - 1] - sparse.eye_array(frames, format="csr")[:-1]
    rows, values = [sparse.eye_array(frames, format="csr")[:1]], [np.zeros((1, 3))]
    for foot in range(firmness.shape[1]):
        weight = np.minimum(firmness[1:, foot], firmness[:-1, foot]) * fps / settings.slip
        rows.append(sparse.diags_array(weight).tocsr() @ change)
        values.append(-steps[:, foot] * weight[:, None])
    bend, target = _bending(flight, center_of_mass, fps, settings)
    # The three coordinates of each frame follow each other.
    matrix = sparse.kron(sparse.vstack([*rows, bend]), sparse.eye_array(3), format="csr")
    right = np.concatenate([*values, target]).ravel()
    if seen is not None:
        about, told = _seen_rows(seen, settings)
        room = sparse.csr_array((matrix.shape[0], about.shape[1] - matrix.shape[1]))
        matrix = sparse.vstack([sparse.hstack([matrix, room]), about], format="csr")
        right = np.concatenate([right, told])
    normal = (matrix.T @ matrix + 1e-9 * sparse.eye_array(matrix.shape[1])).tocsc()
    out = sparse.linalg.spsolve(normal, matrix.T @ right)
    misfit = float(((matrix @ out - right) ** 2).sum())
    return out[: 3 * frames].reshape(frames, 3), out[3 * frames :], misfit


def _seen_rows(seen: SeenPlaces, settings: RootSettings) -> tuple[sparse.csr_array, Array]:
    """Rows and values of what pictures tell; three more unknowns come last: the camera's place."""
    axes, value = _seen_scaled(seen, settings)
    rows = sparse.hstack([sparse.block_diag(list(axes)), -sparse.csr_array(axes.reshape(-1, 3))], format="csr")
    return rows, value.ravel()


def _seen_scaled(seen: SeenPlaces, settings: RootSettings) -> tuple[Array, Array]:
    """Axes ``[T, 3, 3]`` over the scales of their residuals, and the places ``[T, 3]`` along them."""
    scale = np.column_stack([np.full((len(seen.depth), 2), settings.seen), settings.seen_depth * seen.depth])
    axes = seen.axes / scale[:, :, None]
    return axes, np.einsum("tij,tj->ti", axes, seen.places)


def _seen_heights(seen: SeenPlaces, positions: Array, camera: Array, settings: RootSettings) -> tuple[Array, Array]:
    """What pictures tell of the heights where ``positions [T, 3]`` are right along the floor: factors and values."""
    axes, value = _seen_scaled(seen, settings)
    value = value + np.einsum("tij,j->ti", axes, camera)
    return axes[:, :, 2], value - np.einsum("tij,tj->ti", axes[:, :, :2], positions[:, :2])


def _bending(
    flight: NDArray[np.bool_], center_of_mass: Array, fps: float, settings: RootSettings
) -> tuple[sparse.csr_array, Array]:
    """Rows and values of the centre of mass's acceleration: gravity in flight, little on the feet."""
    frames = len(flight)
    if frames < 3:
        return sparse.csr_array((0, frames)), np.zeros((0, 3))
    ones = np.ones(frames - 2)
    second = sparse.diags_array([ones, -2 * ones, ones], offsets=[0, 1, 2], shape=(frames - 2, frames)).tocsr()
    beside = binary_dilation(flight, iterations=max(1, round(settings.settling * fps)))
    scale = np.where(flight, settings.flight, np.where(beside, settings.landing, settings.sway))[1:-1]
    fall = np.outer(flight[1:-1], [0.0, 0.0, -GRAVITY])
    target = (fall - np.diff(center_of_mass, n=2, axis=0) * fps**2) / scale[:, None]
    return sparse.diags_array(fps**2 / scale).tocsr() @ second, target


def _levelled(lowest: Array, contacts: np.ndarray, settings: RootSettings) -> tuple[Support, ...]:
    """Supports with their heights over the first; those close to an earlier one's are put on it.

    Args:
        lowest: ``[T, F]`` m, heights of the feet's lowest points.
        contacts: ``[T, F]``.
        settings: tell which heights are one level.
    """
    runs = sorted(
        (start, stop, foot) for foot in range(contacts.shape[1]) for start, stop in runs_of(contacts[:, foot])
    )
    found: list[Support] = []
    for start, stop, foot in runs:
        height = float(np.median(lowest[start:stop, foot]))
        # What the way here added to the height, by slipping and noise, is taken off against the support before it.
        if found:
            before = found[-1]
            height += before.height - float(np.median(lowest[before.start : before.stop, before.foot]))
            level = settings.level if before.stop >= start else settings.level_in_flight
            near = min((other.height for other in found), key=lambda other: abs(other - height))
            height = near if abs(near - height) < level else height
        else:
            height = 0.0
        found.append(Support(foot, start, stop, height))
    return tuple(found)
