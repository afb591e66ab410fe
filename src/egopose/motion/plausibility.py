"""Could a person have moved like this? Checks of a motion that was read, and of what retargeting made of it.

A wrong unit, up axis or joint still gives numbers that look well: every limb is scaled to the model, and soles are put
on the floor. So the source's size, posture and speeds are looked at, and where the result's feet are.

Errors are for what no person does and what one option mends: such a clip would be learnt wrong. Warnings are for what
people seldom do: handstands, sleep and dancing on the toes are real.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from os import PathLike

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.calibration import part_positions
from egopose.motion.contacts import point_speeds
from egopose.motion.io.body_size import stature
from egopose.motion.mapping import SIDES, identify, sample
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: m: small children to the tallest people; and what not even babies and giants reach, but wrong units do.
STATURE, ANY_STATURE = (0.8, 2.3), (0.5, 3.0)
#: Model's legs over the source's, for the sizes above and legs of any share.
SCALE = (0.3, 3.0)
#: mm between a retargeted part and its source: bounds of real rigs are a third of it.
LARGEST_ERROR = 50.0
#: m/s: the fastest sprint is 12.4; a pitcher's hand reaches 40.
_HIPS_SPEED, _PART_SPEED = 12.5, 40.0
#: Shares of the frames: beyond the first, impossible speeds are no glitch; the others say "nearly always".
_GLITCHES, _MOSTLY, _ALWAYS = 0.05, 0.5, 0.9
#: m: a body further from the floor than this does not touch it.
_OFF_FLOOR = 0.05
#: Slope of a sole that stands on its ball, degrees.
_ON_TOES = 10.0


@dataclass(frozen=True)
class Finding:
    """One thing that is not as people move.

    Args:
        severity: ``"error"`` or ``"warning"``.
        what: a sentence without its full stop.
        joint: of the source or part of the body, or None for the whole.
        frame: the first or worst one, or None for all.
        value: what was measured, in the unit ``what`` says.
        option: what to set if the clip is not so.
    """

    severity: str
    what: str
    joint: str | None
    frame: int | None
    value: float
    option: str

    def __str__(self) -> str:
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(word for word in (self.joint, frame) if word)
        return f"{self.what}{f' ({place})' if place else ''}; {self.option}"


def source_findings(motion: Motion, overrides: Mapping[str, str] | None = None) -> list[Finding]:
    """What is odd about a motion of any humanoid skeleton; nothing is said of a skeleton that is no humanoid's.

    Args:
        motion: z up, metres.
        overrides: part -> joint, see :func:`egopose.motion.mapping.identify`.
    """
    positions, quats = motion.forward_kinematics()
    try:
        body_map = identify(motion.skeleton, dict(overrides or {}), sample(positions))
    except InputError:
        return []
    points = part_positions(body_map, positions, quats, motion.skeleton)
    height = stature(motion.skeleton, sample(positions))
    out = []
    if not STATURE[0] <= height <= STATURE[1]:
        # Refused where nobody is so tall: with a wrong unit the clip's speeds and falls are wrong too, and a puppet's
        # unit can be set as a number.
        severity = "warning" if ANY_STATURE[0] <= height <= ANY_STATURE[1] else "error"
        what = f"the person is {height:.3g} m tall"
        option = "if the unit is wrong, give it: reader.unit=cm, or metres a unit"
        out.append(Finding(severity, what, None, None, height, option))
    return [*out, *_posture(points, height, motion.fps), *_speeds(points, motion.fps)]


def _posture(points: dict[str, Array], height: float, fps: float) -> list[Finding]:
    """Upside down or lying. Only warned of: handstands and sleep are real, a wrong up axis looks the same."""
    trunk = points["neck"] - points["hips"]
    rises = trunk[:, 2] / np.maximum(np.linalg.norm(trunk, axis=1), 1e-9)
    option = "if the person is upright, give the file's up axis: reader.up=z"
    out = []
    inverted = (rises < -0.5) & (points["head" if "head" in points else "neck"][:, 2] < points["hips"][:, 2])
    start, length = _longest_run(inverted)
    # Cartwheels and rolls are over within a second.
    if length > 1.0 * fps or inverted.mean() > _MOSTLY:
        what = f"the head is below the hips in frames {start} to {start + length - 1}"
        out.append(Finding("warning", what, None, start, float(inverted.mean()), option))
    lying = np.abs(rises) < 0.5
    if lying.mean() > _ALWAYS:
        what = f"the person lies or bends down in {lying.mean():.0%} of the frames"
        out.append(Finding("warning", what, None, int(np.argmax(lying)), float(lying.mean()), option))
    return out


def _speeds(points: dict[str, Array], fps: float) -> list[Finding]:
    """Jumps in single frames are warned of, they can be cut; where many are impossible, rate or unit is wrong."""
    names = [name for name in points if len(points[name]) > 1]
    if not names:
        return []
    speeds = point_speeds(np.stack([points[name] for name in names], axis=1), fps)
    bounds = np.array([_HIPS_SPEED if name == "hips" else _PART_SPEED for name in names])
    beyond = (speeds > bounds).any(axis=1)
    if not beyond.any():
        return []
    frame, part = np.unravel_index(int(np.argmax(speeds / bounds)), speeds.shape)
    severity = "error" if beyond.mean() > _GLITCHES else "warning"
    what = f"{speeds[frame, part]:.0f} m/s, faster than people move, in {int(beyond.sum())} frames"
    option = "cut the frames where the capture jumps, or give the frame rate: reader.fps=30"
    return [Finding(severity, what, names[part], int(frame), float(speeds[frame, part]), option)]


def retarget_findings(
    position_mm: Mapping[str, tuple[float, float]], worst_frame: Mapping[str, int], scale: float
) -> list[Finding]:
    """What is odd about a retargeting.

    Args:
        position_mm: part -> mean and largest distance to the scaled source, mm.
        worst_frame: part -> where it is largest.
        scale: model leg length / source leg length.
    """
    out = []
    if not SCALE[0] <= scale <= SCALE[1]:
        # Refused: some bone that is no leg was taken for one.
        what = f"the model's legs are {scale:.3g} times the source's"
        out.append(
            Finding("error", what, "legs", None, scale, "name the joints: mapping.left_shin=NAME, or reader.unit")
        )
    for part, (mean, largest) in sorted(position_mm.items(), key=lambda item: -item[1][0]):
        if largest > LARGEST_ERROR:
            # On average a wrong joint plays the part; in single frames the person bent further than the model can.
            severity, value = ("error", mean) if mean > LARGEST_ERROR else ("warning", largest)
            what = f"retargeting misses the source by {value:.0f} mm{' on average' if severity == 'error' else ''}"
            option = f"if the part is another joint, name it: mapping.{part}=NAME"
            out.append(Finding(severity, what, part, worst_frame.get(part), value, option))
            break
    return out


def floor_findings(soles: Array, contacts: np.ndarray, lowest: Array) -> list[Finding]:
    """What is odd about a settled clip's feet. Only warned of: people jump, climb, and dance on their toes.

    Args:
        soles: ``[T, 2, 2, 3]`` m, right and left foot's heel and ball.
        contacts: ``[T, 2, 2]`` whether they touch the floor.
        lowest: ``[T]`` m height of the body's lowest point but the feet's.
    """
    out = []
    bottom = np.minimum(soles[..., 2].min(axis=(1, 2)), lowest)
    floats = bottom > _OFF_FLOOR
    option = "give the file's up axis (reader.up) or unit (reader.unit) if they were not found"
    if floats.mean() > _MOSTLY:
        what = f"nothing touches the floor in {floats.mean():.0%} of the frames"
        out.append(Finding("warning", what, None, int(np.argmax(floats)), float(floats.mean()), option))
    if bottom.min() < -_OFF_FLOOR:
        what = f"the body is up to {-100 * bottom.min():.0f} cm under the floor"
        out.append(Finding("warning", what, None, int(np.argmin(bottom)), float(bottom.min()), option))
    sole = soles[:, :, 1] - soles[:, :, 0]
    slope = np.rad2deg(np.arcsin(np.clip(-sole[..., 2] / np.linalg.norm(sole, axis=-1), -1.0, 1.0)))
    for k, side in enumerate(SIDES):
        stands = contacts[:, k].any(axis=1)
        if stands.mean() > _GLITCHES and (slope[stands, k] > _ON_TOES).mean() > _ALWAYS:
            degrees = float(np.median(slope[stands, k]))
            what = f"the foot stands on its toes whenever it stands, {degrees:.0f} degrees steep"
            option = f"if it stands flat, name the joint at its toes: mapping.{side}_toe=NAME"
            out.append(Finding("warning", what, f"{side}_foot", int(np.argmax(stands)), degrees, option))
    return out


def refuse(findings: Iterable[Finding], source: str | PathLike[str]) -> list[str]:
    """The warnings as lines.

    Raises:
        InputError: one of the findings is an error; names the source, the joint and the option.
    """
    findings = list(findings)
    for finding in findings:
        if finding.severity == "error":
            raise InputError(source, finding.joint or "motion", str(finding))
    return [str(finding) for finding in findings]


def tell(findings: Iterable[Finding], name: str, write: Callable[[str], object]) -> None:
    """Every finding as a line for people who look at or convert a motion: nothing is refused there."""
    for finding in findings:
        write(f"warning: {name}: {finding}")


def _longest_run(flags: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest run of True ``[T]``; (0, 0) if there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return 0, 0
    best = int(np.argmax(stops - starts))
    return int(starts[best]), int(stops[best] - starts[best])
