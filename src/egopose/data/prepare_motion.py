"""From any motion to a reference clip: on the humanoid's skeleton, at the control rate, settled on the floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.soles import lowest_points, sole_edges, sole_names, sole_positions
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.plant import plant_feet
from egopose.motion.plausibility import floor_findings, refuse, retarget_findings, source_findings
from egopose.motion.retarget import RetargetReport, retarget
from egopose.motion.rotations import Array
from egopose.motion.settle import SettleSettings, settle

#: A posed body's joints move less than this in a frame, m.
_STILL = 0.002


@dataclass(frozen=True)
class PreparationSettings:
    """See ``conf/data``.

    Args:
        cutoff_hz: of the zero-lag low-pass over the retargeted motion; None for none.
        settle: see :class:`egopose.motion.settle.SettleSettings`.
    """

    cutoff_hz: float | None = 8.0
    settle: SettleSettings = field(default_factory=SettleSettings)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> PreparationSettings:
        """From a resolved config group ``{cutoff_hz, settle: {...}}``."""
        return cls(values.get("cutoff_hz", 8.0), SettleSettings(**dict(values.get("settle", {}))))


def without_lead_in(motion: Motion) -> Motion:
    """The motion without frames at its ends that are not of it: many exports begin or end with a T-pose.

    They are told by a jump: some joint moves further in one frame than 0.15 m and five times as far as it usually does.
    Up to half a second of frames is left out where they stand quite still before (or after) the jump; one frame alone
    has nothing to stand still against.
    """
    if len(motion) < 3:
        return motion
    positions, _ = motion.forward_kinematics()
    local = positions - positions[:, :1]
    jumps = np.linalg.norm(np.diff(local, axis=0), axis=2).max(axis=1)
    longest = min(round(0.5 * motion.fps), len(motion) // 2)
    start, cut = _posed_frames(jumps, longest), _posed_frames(jumps[::-1], longest)
    return motion.slice(start, len(motion) - cut) if start + cut < len(motion) else motion


def _posed_frames(jumps: Array, longest: int) -> int:
    """Frames before the first jump of ``jumps [T - 1]`` (m a frame), where they stand still; ``longest`` at most."""
    far = np.flatnonzero(jumps[:longest] > max(0.15, 5 * np.median(jumps[1:])))
    return int(far[0]) + 1 if len(far) and (jumps[: far[0]] < _STILL).all() else 0


def low_pass(motion: Motion, cutoff_hz: float) -> Motion:
    """The motion without what is faster than ``cutoff_hz``: a second-order Butterworth filter, forward and back.

    Marker jitter turns into accelerations no muscle makes; gait analysis filters at 6 Hz (Winter 2009).
    """
    if len(motion) < 8 or cutoff_hz >= motion.fps / 2:
        return motion
    sections = butter(2, cutoff_hz, fs=motion.fps, output="sos")
    qpos = motion.qpos.copy()
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    qpos = sosfiltfilt(sections, qpos, axis=0, padtype="odd", padlen=min(12, len(qpos) - 1))
    qpos[:, 3:7] = rot.normalize(qpos[:, 3:7])
    return replace(motion, qpos=qpos)


def reference_motion(
    motion: Motion,
    humanoid: HumanoidModel,
    settings: PreparationSettings | None = None,
    overrides: dict[str, str] | None = None,
) -> tuple[Motion, RetargetReport]:
    """Retarget, resample to the control rate and settle.

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
    clip, shift = settle(
        clip,
        sole_positions(humanoid, clip),
        settings.settle,
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
        settings.settle.depth,
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
