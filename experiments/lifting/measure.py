"""Lifting and inverse kinematics against calibrated film and mocap.

python experiments/lifting/measure.py POSE2SIM CMU_PEOPLE [--tracks FOLDER] [--network FOLDER]

POSE2SIM is the package's folder, from ``pip download pose2sim --no-deps`` and ``unzip``. Writes README.md and
result.json beside this file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from film import View, views
from robustness import robustness_figures
from scores import KEYPOINTS, ROWS, mpjpe, pa_mpjpe, rooted
from solving import film_figures, mocap_figures
from text import page

from egopose.checkpoint.lifting import load_lifting_network
from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.motion.rotations import Array
from egopose.pipeline.mocap_sources import clips_of
from egopose.scene.lifting import LANDMARK_SHARE, LiftingNetwork, camera_axes, lift
from egopose.scene.poses.track import PoseTrack

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Views by which the shares are chosen. In the third the man was followed, whatever place was given.
CHOOSING = (0, 1, 3)
#: Views of the man in which left and right keep their places.
PLAIN = ("cam01", "cam03", "cam04")
PARTS = ("lifting", "choosing", "ik_mocap", "ik_film", "robustness")


def judged(points: Array, view: View) -> dict[str, float]:
    """Both errors of points ``[T, 28, 3]`` or ``[T, 12, 3]`` in the camera's own axes, mm."""
    joints = points[:, ROWS] if points.shape[1] != len(KEYPOINTS) else points
    return {"mpjpe": mpjpe(joints, view.truth), "pa": pa_mpjpe(joints, view.truth)}


def rows_of(network: LiftingNetwork, track: PoseTrack, view: View) -> dict[str, dict[str, float]]:
    """Errors of the landmarks, the lifter and their mean."""
    assert track.positions is not None
    raw = track.positions[:, [track.schema.index(name) for name in KEYPOINTS]]
    focal = float(view.camera.intrinsics[0, 0])
    out = {"landmarks as they come": judged(raw, view)}
    for name, share in {"landmarks": (1.0, 1.0), "lifter": (0.0, 0.0), "mean": LANDMARK_SHARE}.items():
        out[name] = judged(camera_axes(lift(track, network, landmark_share=share), track), view)
    out["mean, lens known"] = judged(camera_axes(lift(track, network), track, focal), view)
    out["lifter, 1.7 m"] = judged(camera_axes(lift(track, network, height=1.7, landmark_share=(0.0, 0.0)), track), view)
    return out


def lifting_figures(network: LiftingNetwork, man: list[View]) -> dict[str, Any]:
    """Each view before and after sides are mended."""
    out: dict[str, Any] = {}
    for view in man:
        row = {"before": rows_of(network, view.track, view), "after": rows_of(network, view.mended, view)}
        out[view.camera.name] = {**row, "swapped": int(view.mended.swapped.sum()), "off_px": view.off_px}
    return out


def shares(network: LiftingNetwork, woman: list[View]) -> dict[str, float]:
    """Mean error for shares of the landmarks across the picture and in depth, sizes aligned (mm)."""
    out = {}
    for across in SHARES:
        for depth in SHARES:
            errors = []
            for view in woman:
                points = camera_axes(lift(view.mended, network, landmark_share=(across, depth)), view.mended)
                joints = rooted(points[:, ROWS])
                known = np.isfinite(joints).all(axis=(1, 2))
                size = (joints[known] * view.truth[known]).sum() / (joints[known] ** 2).sum()
                errors.append(mpjpe(size * joints, view.truth))
            out[f"{across:g} {depth:g}"] = float(np.mean(errors))
    return out


def main() -> None:
    """Measure all; write both files."""
    parser = argparse.ArgumentParser()
    parser.add_argument("pose2sim", type=Path)
    parser.add_argument("cmu_people", type=Path)
    parser.add_argument("--tracks", type=Path, default=Path("outputs/lifting_tracks"))
    parser.add_argument("--network", type=Path, default=None)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="others stay as result.json has them")
    given = parser.parse_args()
    folder, parts = Path(__file__).parent, set(given.parts)
    kept = folder / "result.json"
    result: dict[str, Any] = json.loads(kept.read_text()) if parts != set(PARTS) and kept.exists() else {}
    values = compose_config("lifter", [f"sources.cmu_people={given.cmu_people}", "out=unused"])
    humanoid = humanoid_of(values)
    if "ik_mocap" in parts:
        result["ik_mocap"] = mocap_figures(humanoid, clips_of(values, "conf/lifter.yaml")[1])
    if parts - {"ik_mocap"}:
        network = load_lifting_network(given.network)
        man = views(given.pose2sim, given.tracks, "man")
        woman = [views(given.pose2sim, given.tracks, "woman")[k] for k in CHOOSING]
        makers: dict[str, Callable[[], Any]] = {
            "lifting": lambda: lifting_figures(network, man),
            "choosing": lambda: shares(network, woman),
            "ik_film": lambda: film_figures(humanoid, network, man),
            "robustness": lambda: robustness_figures(humanoid, network, man, woman),
        }
        result |= {name: make() for name, make in makers.items() if name in parts}
        result["landmark_share"] = LANDMARK_SHARE
    kept.write_text(json.dumps(result, indent=1))
    if set(result) >= set(PARTS):
        plain = [result["lifting"][name]["after"]["mean"]["mpjpe"] for name in PLAIN]
        text = page({**result, "mean_of_plain_views": float(np.mean(plain))})
        (folder / "README.md").write_text(text)
        print(text)


if __name__ == "__main__":
    main()
