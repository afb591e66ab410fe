"""A humanoid with the bones of any motion's own skeleton.

Joints, degrees of freedom, gains and shares of mass stay those of the config's table; lengths come from the source.
Rigs disagree about zero poses and about joints inside the trunk, so lengths are measured between recognised parts over
the clip (medians), and directions stay the table's: straight limbs, arms sideways, a spine along z.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from egopose.core.errors import InputError
from egopose.humanoid.config import HumanoidConfig, SimConfig, Vector
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion.calibration import neutral_stance, part_positions
from egopose.motion.mapping import SIDES, identify, sample
from egopose.motion.motion import Motion
from egopose.motion.plausibility import refuse, source_findings
from egopose.motion.rotations import Array
from egopose.motion.scaling import MODEL_PARTS, MODEL_SPINE, model_points


def humanoid_from_motion(
    motion: Motion,
    config: HumanoidConfig,
    sim: SimConfig | None = None,
    overrides: dict[str, str] | None = None,
) -> HumanoidModel:
    """The simulated humanoid with the bone lengths of a motion's skeleton, for any humanoid BVH in one call.

    Args:
        motion: of any humanoid skeleton, z up, metres.
        config: the table of joints, gains and masses; ``total_mass`` stays as it says.
        sim: rates of the physics.
        overrides: part -> source joint, see :func:`egopose.motion.mapping.identify`.

    Raises:
        InputError: the skeleton is not recognised as a humanoid or is no person's, or the config's joints are not the
            default table's.
    """
    return build_humanoid(config_from_motion(motion, config, overrides), sim)


def config_from_motion(
    motion: Motion, config: HumanoidConfig, overrides: dict[str, str] | None = None
) -> HumanoidConfig:
    """The table with its offsets, tips, feet and radii fitted to a motion's skeleton; see :func:`humanoid_from_motion`.

    What a skeleton does not show is scaled: soles and hands with the legs and forearms, heads and spine with the trunk.
    """
    wanted = {*MODEL_PARTS.values(), *MODEL_SPINE}
    if missing := wanted - {row.name for row in config.joints}:
        raise InputError("conf/humanoid", "joints", f"a fitted humanoid needs {', '.join(sorted(missing))}")
    positions, quats = motion.forward_kinematics()
    body_map = identify(motion.skeleton, overrides, sample(positions))
    points = part_positions(body_map, positions, quats, motion.skeleton)
    for line in refuse(source_findings(motion, overrides), motion.meta.get("source") or motion.name or "motion"):
        warnings.warn(line, stacklevel=2)
    stance = neutral_stance(motion, body_map, quats, points).points
    skeleton = config.skeleton()
    rest = {part: p[0] for part, p in model_points(skeleton, skeleton.rest_qpos()[None]).items()}
    points["centre"] = (points["left_thigh"] + points["right_thigh"]) / 2
    rest["centre"] = (rest["left_thigh"] + rest["right_thigh"]) / 2

    def ratio(links: Iterable[tuple[str, str]]) -> float:
        """Source over table, of the links' summed lengths."""
        source = sum(_length(points[a], points[b]) for a, b in links)
        return source / sum(float(np.linalg.norm(rest[a] - rest[b])) for a, b in links)

    def both(a: str, b: str) -> list[tuple[str, str]]:
        return [(f"{s}_{a}", f"{s}_{b}") for s in SIDES]

    thigh, shin = ratio(both("thigh", "shin")), ratio(both("shin", "foot"))
    arm, forearm = ratio(both("arm", "forearm")), ratio(both("forearm", "hand"))
    hips, shoulders = ratio([("left_thigh", "right_thigh")]), ratio([("left_arm", "right_arm")])
    leg = ratio(both("thigh", "shin") + both("shin", "foot"))
    foot = ratio(both("foot", "toe")) if all(f"{s}_toe" in points for s in SIDES) else leg
    offsets = {name: np.array(offset) for name, offset in config.offsets.items()}
    # The root stands above the hip joints by a share of the legs; the spine has the rest of the way to the neck.
    drop = float(rest["hips"][2] - rest["centre"][2])
    trunk = (_length(points["neck"], points["centre"]) - leg * drop) / float(rest["neck"][2] - rest["hips"][2])
    neck = ratio([("neck", "head")]) if "head" in points else trunk
    for name in (*MODEL_SPINE, "Neck"):
        offsets[name] = offsets[name] * trunk
    offsets["Head"] = offsets["Head"] * neck
    # Shoulders sit as high below the neck as in the source's upright stance.
    below_neck = float(np.mean([stance[f"{s}_arm"][2] for s in SIDES]) - stance["neck"][2])
    for side in ("Right", "Left"):
        collar, upper = offsets[f"{side}Shoulder"], offsets[f"{side}Arm"]
        height = offsets["Neck"][2] + below_neck
        offsets[f"{side}Shoulder"] = np.array([collar[0] * shoulders, collar[1] * shoulders, height])
        offsets[f"{side}Arm"] = upper * [shoulders, shoulders, 0.0]
        offsets[f"{side}UpLeg"] = offsets[f"{side}UpLeg"] * [leg, hips, leg]
        for name, factor in (("ForeArm", arm), ("Hand", forearm), ("Leg", thigh), ("Foot", shin)):
            offsets[side + name] = offsets[side + name] * factor
    factors = {config.head: trunk} | dict.fromkeys(config.feet, foot) | dict.fromkeys(config.hands, forearm)
    tips = {name: _vector(np.array(tip) * factors[name]) for name, tip in config.tips.items()}
    return replace(
        config,
        joints=tuple(replace(row, radius=row.radius * leg) for row in config.joints),
        offsets={name: _vector(offset) for name, offset in offsets.items()},
        tips=tips,
        # A sole must lie below the toe joint whatever the foot's length: ankle, toe and heel go with the foot together.
        ankle_height=config.ankle_height * foot,
        toe_height=config.toe_height * foot,
        heel_length=config.heel_length * foot,
        toe_overhang=config.toe_overhang * foot,
        foot_width=config.foot_width * foot,
    )


def _length(a: Array, b: Array) -> float:
    """Median over the clip of the distance between points ``[T, 3]``, m."""
    return float(np.median(np.linalg.norm(a - b, axis=1)))


def _vector(values: Array) -> Vector:
    x, y, z = (float(v) for v in values)
    return (x, y, z)
