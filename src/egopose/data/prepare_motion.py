"""From any motion to a reference clip: on the humanoid's skeleton, at the control rate, standing on the floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from egopose.data.reference import reference_states
from egopose.humanoid.foot_geometry import lowest_points, sole_edges, sole_names, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.foot_contact_ik import plant_feet
from egopose.motion.ground_alignment import GroundAlignmentSettings, align_to_ground
from egopose.motion.motion import Motion
from egopose.motion.notes import with_note
from egopose.motion.plausibility import floor_findings, refuse, retarget_findings, source_findings
from egopose.motion.retarget import RetargetReport, retarget
from egopose.motion.rotations import Array

#: m: what a leap into the motion is, what a held pose may sway by, and what no recording keeps within.
_LEAP, _STILL, _FROZEN = 0.15, 0.05, 1e-4

#: Width over height of the joints in a T-pose; a body of usual proportions has 0.9, with its arms at 45 degrees 0.65.
_WIDE = 0.75


@dataclass(frozen=True)
class PreparationSettings:
    """See ``conf/data``.

    Args:
        cutoff_hz: of the zero-lag low-pass over the retargeted motion; None for none.
        ground_alignment: see :class:`egopose.motion.ground_alignment.GroundAlignmentSettings`.
    """

    cutoff_hz: float | None = 8.0
    ground_alignment: GroundAlignmentSettings = field(default_factory=GroundAlignmentSettings)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> PreparationSettings:
        """From a resolved config group ``{cutoff_hz, ground_alignment: {...}}``."""
        return cls(values.get("cutoff_hz", 8.0), GroundAlignmentSettings(**dict(values.get("ground_alignment", {}))))


def without_lead_in(motion: Motion) -> Motion:
    """The motion without still poses before and after it that are not of it: many exports begin with a T-pose.

    Such a pose is told by the leap between it and the motion: in one frame some joint moves further than 0.15 m, five
    times as far as it usually does, and twice as far as in the next frame. Who stands in a T-pose and moves out of it
    makes no leap. Several frames must besides be frozen, as no recording is, or a T-pose. What was cut is noted in
    ``meta["notes"]``.
    """
    if len(motion) < 3:
        return motion
    positions, _ = motion.forward_kinematics()
    local = positions - positions[:, :1]
    before = _still_frames(local)
    after = _still_frames(local[before:][::-1])
    for count, where in ((before, "before"), (after, "after")):
        if count:
            frames = "a frame" if count == 1 else f"{count} frames"
            motion = with_note(motion, f"{frames} of a still pose {where} the motion were cut: they do not belong")
    return motion.slice(before, len(motion) - after) if before or after else motion


def _still_frames(local: Array) -> int:
    """How many frames at the beginning are a pose that the motion leaps out of.

    Args:
        local: ``[T, J, 3]`` positions of the joints less the root's (m, z up).
    """
    start = 0
    while len(local) - start > 2:
        rest = local[start:]
        leaves = np.linalg.norm(rest - rest[0], axis=2).max(axis=1) > _STILL
        count = int(np.argmax(leaves)) if leaves.any() else 0
        if not count or not _leaps(rest[count - 1 :]):
            break
        held, motion = rest[:count], rest[count:]
        t_pose = _is_t_pose(held[0])
        if count > 1 and not t_pose and np.abs(held - held[0]).max() > _FROZEN:
            break
        if count >= len(motion) and not (t_pose and not _is_t_pose(motion[len(motion) // 2])):
            break
        start += count
    return start


def _leaps(local: Array) -> bool:
    """Whether the first step is a leap beside all others."""
    steps = np.linalg.norm(np.diff(local, axis=0), axis=2).max(axis=1)
    usual, following = (float(np.median(steps[1:])), float(steps[1])) if len(steps) > 1 else (0.0, 0.0)
    return bool(steps[0] > max(_LEAP, 5 * usual, 2 * following))


def _is_t_pose(local: Array) -> bool:
    """Whether the body is about as wide as it is high."""
    ground = local[:, :2]
    width = np.linalg.norm(ground[:, None] - ground[None], axis=2).max()
    return bool(width > _WIDE * np.ptp(local[:, 2]))


def low_pass(motion: Motion, cutoff_hz: float) -> Motion:
    """The motion without what is faster than ``cutoff_hz``: a second-order Butterworth filter, forward and back.

    Marker jitter turns into accelerations no muscle makes; gait analysis filters at 6 Hz (Winter 2009).
    """
    if len(motion) < 8 or cutoff_hz >= motion.fps / 2:
        return motion
    sections = scipy.signal.butter(2, cutoff_hz, fs=motion.fps, output="sos")
    qpos = motion.qpos.copy()
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    qpos = scipy.signal.sosfiltfilt(sections, qpos, axis=0, padtype="odd", padlen=min(12, len(qpos) - 1))
    qpos[:, 3:7] = rot.normalize(qpos[:, 3:7])
    return replace(motion, qpos=qpos)


def reference_motion(
    motion: Motion,
    humanoid: HumanoidModel,
    settings: PreparationSettings | None = None,
    overrides: dict[str, str] | None = None,
) -> tuple[Motion, RetargetReport]:
    """Retarget, resample to the control rate and put on the floor.

    Args:
        motion: of any humanoid skeleton, z up.
        humanoid: whose skeleton and joint limits are used.
        settings: of filter and settling.
        overrides: part -> source joint, see :func:`egopose.motion.mapping.identify`.

    Returns:
        The reference clip with contacts of the four sole points, and the retargeting report with warnings of what is
        odd about it (:mod:`egopose.motion.plausibility`).

    Raises:
        InputError: the skeleton is not recognised as a humanoid, or no person moves so.
    """
    settings = settings or PreparationSettings()
    fps = 1.0 / humanoid.control_dt
    # Twice the control rate keeps what inverse kinematics needs to tell neighbours apart, at a fraction of 120 fps.
    motion = without_lead_in(motion)
    source = motion.resample(2 * fps) if motion.fps > 2 * fps else motion
    retargeted, report = retarget(source, humanoid.skeleton, humanoid.joint_range, overrides)
    if settings.cutoff_hz is not None:
        retargeted = low_pass(retargeted, settings.cutoff_hz)
    clip = retargeted.resample(fps)
    clip = replace(clip, contact_names=sole_names(humanoid), contacts=None)
    clip, shift = align_to_ground(
        clip,
        sole_positions(humanoid, clip),
        settings.ground_alignment,
        sole_edges=sole_edges(humanoid, clip),
        center_of_mass=reference_states(humanoid, clip)["com"].numpy(),
        lowest=lowest_points(humanoid, clip),
    )
    clip = plant_feet(
        clip,
        np.repeat(humanoid.feet, humanoid.sole_points.shape[1]),
        humanoid.sole_points.reshape(-1, 3),
        sole_positions(humanoid, clip),
        humanoid.joint_range,
        settings.ground_alignment.depth,
    )
    centred = clip.qpos.copy()
    centred[:, :2] -= centred[:1, :2]
    clip = replace(clip, qpos=centred)
    soles = sole_positions(humanoid, clip).reshape(len(clip), 2, 2, 3)
    contacts = np.asarray(clip.contacts).reshape(len(clip), 2, 2)
    findings = [
        *source_findings(source, overrides),
        *retarget_findings(report.position_mm, report.worst_frame, report.scale),
        *floor_findings(soles, contacts, lowest_points(humanoid, clip)),
    ]
    warnings = tuple(refuse(findings, motion.meta.get("source") or motion.name or "motion"))
    shifts = (float(shift.mean()), float(shift.min()), float(shift.max()))
    return clip, replace(report, ground_shift_m=shifts, warnings=warnings)
