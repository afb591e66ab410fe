"""python experiments/reconstruction_policy/folder.py NAME OUT: a true clip of the scene bench as a prepared folder.

The poses and the scene are the true ones, and the plan is the true simulated motion. So what a policy does with them
tells of the training alone.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.motion.io.native import write_native
from egopose.motion.motion import Motion
from egopose.scene.contacts import FEET
from egopose.scene.scene_file import read_scene
from egopose.scene.simulated import load_simulated
from egopose.scene.supports import told_contacts

CLIPS = Path(__file__).parents[1] / "scene_bench" / "clips"


def main(name: str, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    truth, scene = load_simulated(CLIPS / name / "truth.npz"), read_scene(CLIPS / name / "scene.yaml")
    touching = told_contacts(scene, len(truth))
    assert touching is not None
    names = tuple(f"{side.capitalize()}Foot" for side in FEET)
    skeleton = humanoid_of(compose_config("train")).skeleton
    motion = Motion(skeleton, truth.qpos, scene.fps, contacts=touching, contact_names=names)
    write_native(motion, out / "body.npz")
    np.savez_compressed(out / "contacts.npz", probability=touching.astype(float), touching=touching)
    shutil.copy(CLIPS / name / "scene.yaml", out)
    truth.save(out / "plan.npz")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
