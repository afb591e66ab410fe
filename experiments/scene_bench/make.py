"""Make the true clips: python experiments/scene_bench/make.py CMU_PEOPLE DEEPMIMIC [NAME ...].

CMU_PEOPLE is the folder of clips.csv and the unpacked archives, DEEPMIMIC that of DeepMimic's clips.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egopose.benchmarks.scene_contacts import touching, true_contacts
from egopose.benchmarks.scene_truth import TruthSettings, track
from egopose.benchmarks.scene_warp import Platform, Stance, boxes_under, lifted, stances
from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import low_pass, reference_motion
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget
from egopose.scene.clip import humanoid_in
from egopose.scene.scene_file import Scene, write_scene

CLIPS = Path(__file__).parent / "clips"
SOUTH, NORTH = -np.pi / 2, np.pi / 2  # the way these people walk


@dataclass(frozen=True)
class Recipe:
    """A clip: where its mocap lies, which frames at 30 frames/s, and what the feet stand on.

    ``real``: the steps were there when it was recorded, so nothing is lifted. ``bodies`` track it side by side: jumps
    fail one body in some. ``hands`` stand on things, too.
    """

    file: str
    first: int
    last: int
    platforms: tuple[Platform, ...] = ()
    real: bool = False
    skip: int = 0
    bodies: int = 1
    hands: bool = False


RECIPES = {
    "steps_up": Recipe(
        "cmu_cgspeed_daz/14_21.bvh",
        20,
        130,
        (
            Platform("step1", 19, 53, 0.25, (0.04, 0.25), NORTH, 1),
            Platform("step2", 49, 79, 0.47, (0.0, 0.30), NORTH, 0),
            Platform("step3", 74, 109, 0.735, (0.03, 0.30), NORTH),
        ),
        real=True,
        skip=4,
    ),
    "jump_boxes": Recipe(
        "cmu_cgspeed_daz/01_01.bvh",
        38,
        132,
        (
            Platform("first", 28, 70, 0.15, (0.12, 0.15), SOUTH),
            Platform("second", 76, 94, 0.1, (0.15, 0.15), SOUTH),
        ),
        skip=4,
        bodies=4,
    ),
    "walk_boxes": Recipe(
        "cmu_cgspeed_daz/05_01.bvh",
        0,
        124,
        (
            Platform("low", 28, 47, 0.15, (0.10, 0.25), SOUTH, 1),
            Platform("high", 46, 65, 0.3, (0.10, 0.25), SOUTH, 0),
            Platform("last", 64, 82, 0.15, (0.10, 0.25), SOUTH, 1),
        ),
        skip=4,
    ),
    "jump_down": Recipe(
        "cmu_cgspeed_daz/01_01.bvh", 300, 375, (Platform("box", 0, 20, 0.4, (0.15, 0.15), NORTH),), skip=4
    ),
    "vault": Recipe("humanoid3d_cartwheel.txt", 0, 82, (Platform("box", 33, 48, 0.25, (0.1, 0.1), NORTH),), hands=True),
    "walk_turn": Recipe("long/humanoid3d_long_walk1.txt", 20, 140),
    "cartwheel": Recipe("humanoid3d_cartwheel.txt", 0, 82),
}


def reference(humanoid: HumanoidModel, recipe: Recipe, source: Motion) -> tuple[Motion, list[Stance]]:
    """The mocap on the humanoid and when its feet stand; the lowest floor lies at 0."""
    if not recipe.real:
        motion = reference_motion(source, humanoid)[0].slice(recipe.first, recipe.last)
        return motion, stances(humanoid, motion, hands=recipe.hands)
    fast = source.resample(60.0) if source.fps > 60.0 else source
    motion = low_pass(retarget(fast, humanoid.skeleton, humanoid.joint_range)[0], 8.0).resample(30.0)
    motion = motion.slice(recipe.first, recipe.last)
    qpos = motion.qpos.copy()
    # The foot that stands at first, within the few millimetres that the simulated floor gives.
    qpos[:, 2] -= float(np.median(sole_positions(humanoid, motion)[:5, ..., 2].min(axis=1)))
    motion = replace(motion, qpos=qpos)
    return motion, stances(humanoid, motion, 0.3, None)


def make(humanoid: HumanoidModel, name: str, roots: list[Path]) -> str:
    """Write a clip's truth and scene; a line about it."""
    recipe = RECIPES[name]
    path = next(root / recipe.file for root in roots if (root / recipe.file).is_file())
    source = read_motion(path)
    motion, standing = reference(humanoid, recipe, source.slice(recipe.skip, len(source)))
    start = motion.qpos.copy()
    start[:, :2] -= start[0, :2]
    motion = replace(motion, qpos=start)
    boxes = tuple(boxes_under(humanoid, motion, standing, recipe.platforms))
    if boxes and not recipe.real:
        under = [next((p.height for p in recipe.platforms if p.under(s)), 0.0) for s in standing]
        motion = lifted(humanoid, motion, standing, under)
    scene = Scene(boxes=boxes, notes=(f"truth of {recipe.file}, frames {recipe.first} to {recipe.last - 1}",))
    among = humanoid_in(scene, humanoid)
    began = time.time()
    simulated = track(among, scene, motion, TruthSettings(bodies=recipe.bodies))
    found = touching(among, simulated)
    scene = replace(scene, contacts=true_contacts(among, scene, found))
    out = CLIPS / name
    out.mkdir(parents=True, exist_ok=True)
    simulated.save(out / "truth.npz")
    write_scene(scene, out / "scene.yaml")
    off = np.linalg.norm(simulated.qpos[:, :3] - motion.qpos[:, :3], axis=1)
    others = [humanoid.skeleton.names[b] for b in np.flatnonzero(found.any(axis=(0, 2)))]
    return (
        f"{name}: {len(motion)} frames, {len(boxes)} boxes, root {off.mean():.3f} m off the mocap, "
        f"at most {off.max():.3f}; {', '.join(others)} touch; {time.time() - began:.0f} s"
    )


def main() -> None:
    """Make all clips, or those that are named."""
    roots = [Path(word) for word in sys.argv[1:3]]
    humanoid = humanoid_of(compose_config("train", ["sim=fast"]))
    for name in sys.argv[3:] or RECIPES:
        print(make(humanoid, name, roots), flush=True)


if __name__ == "__main__":
    main()
