"""Motion to follow that is not quite the truth: what a tracker is trained on.

A regressor's states are wrong by some tenths of a radian in every joint, drift, and jitter. A tracker that has only
seen true motion falls over them. So it follows the same motion with smooth errors, and is paid for the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from tensordict import TensorDict
from torch import Tensor

from egopose.data.fragments import FragmentLike
from egopose.data.reference import reference_states
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.problem import TakeTable
from egopose.envs.starts import Piece
from egopose.humanoid.model import HumanoidModel
from egopose.models.mirror import joint_mirror
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class TargetError:
    """How far the target motion is from the truth. Standard deviations of smooth noise, in time and over takes.

    Args:
        joints: rad, of every joint angle.
        tilt: rad, of the root about any level axis.
        heading: rad, slow.
        height: m.
        place: m, along each level axis, slow.
        quick, slow: s, of the Gaussians that smooth the noise: half of a joint's variance is of each.
    """

    joints: float
    tilt: float
    heading: float
    height: float
    place: float
    quick: float
    slow: float


def smooth_noise(rng: np.random.Generator, frames: int, columns: int, deviation: float) -> Array:
    """``[frames, columns]`` noise of unit variance, correlated over ``deviation`` frames."""
    sigma = max(deviation, 0.01)  # white noise, which SciPy's filter refuses to give
    reach = int(4 * sigma) + 1
    noise = gaussian_filter1d(rng.normal(size=(frames + 2 * reach, columns)), sigma, axis=0)[reach:-reach]
    kernel = gaussian_filter1d(np.eye(1, 2 * reach + 1, reach)[0], sigma)
    return np.asarray(noise / np.sqrt((kernel**2).sum()))


def with_error(qpos: Array, fps: float, joint_range: Array, error: TargetError, rng: np.random.Generator) -> Array:
    """``qpos [T, nq]`` with smooth errors; joints stay in their range ``[D, 2]``."""
    frames, dofs = len(qpos), qpos.shape[1] - 7
    quick, slow = error.quick * fps, error.slow * fps

    def mixed(columns: int) -> Array:
        parts = smooth_noise(rng, frames, columns, quick), smooth_noise(rng, frames, columns, slow)
        return (parts[0] + parts[1]) / np.sqrt(2.0)

    out = qpos.copy()
    out[:, :2] += error.place * smooth_noise(rng, frames, 2, 2.0 * slow)
    out[:, 2] += error.height * mixed(1)[:, 0]
    turn = np.column_stack([error.tilt * mixed(2), error.heading * smooth_noise(rng, frames, 1, 2.0 * slow)])
    out[:, 3:7] = rot.normalize(rot.multiply(rot.from_rotvec(turn), qpos[:, 3:7]))
    # People differ in how well their limbs are seen, so each joint of a take has its own share.
    out[:, 7:] += error.joints * rng.uniform(0.3, 1.4, dofs) * mixed(dofs)
    out[:, 7:] = np.clip(out[:, 7:], joint_range[:, 0], joint_range[:, 1])
    return out


def mirrored(humanoid: HumanoidModel, qpos: Array) -> Array:
    """The mirror image of ``qpos [T, nq]`` in the x-z plane."""
    index, sign = joint_mirror(humanoid.skeleton)
    out = np.empty_like(qpos)
    out[:, :7] = qpos[:, :7] * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
    out[:, 7:] = sign * qpos[:, 7:][:, index]
    return out


@dataclass(frozen=True)
class Variants:
    """Takes with the target motion beside the true one, one after the other.

    Args:
        reference: body states ``[F]``.
        takes: where they lie.
        states: ``[F, S]`` humanoid states that are followed.
        joint_targets: ``[F, nu]`` rad, their joint angles.
        path: ``[F, 3]`` x, y (m) and heading (rad) of their root.
        pieces: fragments of all takes.
        unmirrored: those of no mirror image, error by error.
    """

    reference: TensorDict
    takes: TakeTable
    states: Tensor
    joint_targets: Tensor
    path: Tensor
    pieces: list[Piece]
    unmirrored: list[Piece]


def target_variants(
    humanoid: HumanoidModel,
    clips: Sequence[Array],
    fragments: Sequence[FragmentLike],
    errors: Sequence[TargetError | None],
    mirror: bool,
    seed: int,
) -> Variants:
    """Every clip once for each of ``errors`` (None for the truth itself), and its mirror image likewise.

    Args:
        humanoid: whose motion it is.
        clips: ``qpos [T, nq]`` at the control rate.
        fragments: of the clips.
        errors: of the target motion.
        mirror: whether mirror images are added.
        seed: of the errors.
    """
    rng, fps = np.random.default_rng(seed), 1.0 / humanoid.control_dt
    references, states, targets, paths = [], [], [], []
    lengths: list[int] = []
    lowest: list[float] = []
    pieces: list[Piece] = []
    unmirrored: list[Piece] = []
    for side in range(1 + mirror):
        truths = [mirrored(humanoid, clip) for clip in clips] if side else list(clips)
        bodies = [reference_states(humanoid, Motion(humanoid.skeleton, truth, fps)) for truth in truths]
        for error in errors:
            begun = len(lengths)
            for truth, body in zip(truths, bodies, strict=True):
                seen = truth if error is None else with_error(truth, fps, humanoid.joint_range, error, rng)
                rows = humanoid_state_rows(seen, finite_difference(seen, fps))
                root = root_on_floor(torch.from_numpy(seen))
                root[:, 2] = torch.from_numpy(np.unwrap(root[:, 2].numpy()))
                references.append(body)
                states.append(torch.from_numpy(rows).float())
                targets.append(torch.from_numpy(seen[:, 7:]).float())
                paths.append(root)
                lengths.append(len(truth))
                lowest.append(float(body["xpos"][:, humanoid.head, 2].min()))
            these = [Piece(begun + f.take, f.start, f.stop) for f in fragments]
            pieces += these
            unmirrored += [] if side else these
    sizes = torch.tensor(lengths)
    takes = TakeTable(sizes.cumsum(0) - sizes, sizes, torch.tensor(lowest, dtype=torch.float64))
    return Variants(
        torch.cat(references), takes, torch.cat(states), torch.cat(targets), torch.cat(paths), pieces, unmirrored
    )
