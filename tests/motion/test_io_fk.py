"""World positions of every joint on every file of two real sets, against an independent package (`upc-pymotion`)."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
from pymotion.io.bvh import BVH
from pymotion.ops.skeleton import fk

from egopose.motion.io import read_motion
from egopose.motion.kinematics import forward_kinematics

FRAMES_A_FILE = 25


def some_frames(path: Path, frames: np.ndarray, out: Path) -> None:
    """The file again with these frames only: the other package parses a thousand lines a second."""
    head, motion = path.read_text().split("MOTION", 1)
    _, _, frame_time, *rows = motion.splitlines()
    chosen = [rows[k] for k in frames]
    out.write_text("\n".join([f"{head}MOTION", f"Frames: {len(chosen)}", frame_time, *chosen, ""]))


def worst_distance(path: Path, scratch: Path) -> float:
    """Largest distance (m) between our joints and the other package's, over frames spread through the file."""
    motion = read_motion(path)
    frames = np.unique(np.linspace(0, len(motion) - 1, FRAMES_A_FILE).astype(int))
    ours, _ = forward_kinematics(motion.skeleton, motion.qpos[frames])

    other = BVH()
    some_frames(path, frames, scratch)
    other.load(str(scratch))
    rotations, positions, parents, *_ = other.get_data()
    theirs, _ = fk(rotations, positions[:, 0], positions, parents)
    theirs = np.stack([theirs[..., 0], -theirs[..., 2], theirs[..., 1]], axis=-1) * 0.01  # y up, cm
    names = [str(n) for n in other.data["names"]]
    assert set(motion.skeleton.names) | set(motion.meta["folded_roots"]) == set(names)
    order = [names.index(n) for n in motion.skeleton.names]
    return float(np.linalg.norm(ours - theirs[:, order], axis=-1).max())


def test_every_cmu_file_agrees(shared: Path, tmp_path: Path) -> None:
    paths = sorted((shared / "data" / "cmu_bvh60").rglob("*.bvh"))
    assert len(paths) == 54
    assert max(worst_distance(path, tmp_path / "some.bvh") for path in paths) < 1e-4


def test_every_bandai_file_agrees(shared: Path, tmp_path: Path) -> None:
    with tarfile.open(shared / "data" / "bandai1_ccbync4.tar.xz") as archive:
        archive.extractall(tmp_path / "bandai", filter="data")
    paths = sorted((tmp_path / "bandai").rglob("*.bvh"))
    assert len(paths) == 174
    assert max(worst_distance(path, tmp_path / "some.bvh") for path in paths) < 1e-4


def test_the_common_cmu_conversion_lies_on_its_acclaim_original(shared: Path) -> None:
    bvh = read_motion(shared / "data" / "cmu_bvh120" / "01_01.bvh")
    amc = read_motion(shared / "data" / "cmu_amc" / "01_01.amc")
    assert (bvh.meta["unit"], bvh.fps) == ("asf", 120)
    ours, _ = bvh.forward_kinematics()
    original, _ = amc.forward_kinematics()
    # Legs only: the conversion left out the first bone of the spine. It put a T-pose before the first frame.
    for here, there in {"LeftUpLeg": "lfemur", "LeftLeg": "ltibia", "RightFoot": "rfoot"}.items():
        a, b = ours[1:, bvh.skeleton.index(here)], original[:, amc.skeleton.index(there)]
        assert np.linalg.norm(a - b, axis=-1).max() < 2e-3, here
