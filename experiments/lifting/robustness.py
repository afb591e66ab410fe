"""Faults put into the man's keypoints on purpose: what lifting and inverse kinematics make of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from film import View
from ik import WAYS, persons_skeleton, points_of, solved
from scores import mpjpe
from solving import JUDGED, film_points

from egopose.humanoid.model import HumanoidModel
from egopose.scene.lifting import LiftingNetwork
from egopose.scene.poses.following import Candidate, follow
from egopose.scene.poses.mending import fill_gaps
from egopose.scene.poses.track import PoseTrack

GAP = (35, 65)
DROPPED = 0.2


def without(track: PoseTrack, gone: np.ndarray) -> PoseTrack:
    """The track without the keypoints in ``gone [T, K]``."""
    assert track.positions is not None
    pixels, positions = track.pixels.copy(), track.positions.copy()
    pixels[gone], positions[gone] = np.nan, np.nan
    return replace(track, pixels=pixels, positions=positions, confidence=np.where(gone, 0.0, track.confidence))


def robustness_figures(
    humanoid: HumanoidModel, network: LiftingNetwork, man: list[View], woman: list[View]
) -> dict[str, object]:
    """Errors after inverse kinematics (mm), whole and after each fault, and who was followed."""
    random = np.random.default_rng(0)
    out: dict[str, object] = {}
    for view in man:
        track, frames = view.mended, np.zeros(len(view.mended), dtype=bool)
        frames[slice(*GAP)] = True
        gone = np.repeat(frames[:, None], len(track.schema), axis=1)
        cases = {"whole": track, "gap": without(track, gone)}
        cases["dropped"] = without(track, random.random(gone.shape) < DROPPED)
        row: dict[str, object] = {}
        for name, case in cases.items():
            points, truth = film_points(replace(view, mended=case), network), view.truth @ view.camera.axes
            skeleton = persons_skeleton(humanoid.skeleton, points)
            joints = points_of(skeleton, solved(humanoid, skeleton, points, track.fps, WAYS[1:2])[WAYS[1]])[:, JUDGED]
            row[name] = mpjpe(joints, truth)
            row[f"{name}, in the gap"] = mpjpe(joints[frames], truth[frames])
        row["told"] = [note for note in fill_gaps(cases["gap"]).notes if "nobody" in note]
        out[view.camera.name] = row
    out["wrong person"] = [
        wrong_person(view, other) for view in man for other in woman if other.camera.name == view.camera.name
    ]
    return out


def wrong_person(view: View, other: View) -> dict[str, object]:
    """Frames in which a woman is followed while the man is not found for 20 frames; he is chosen in the first frame."""
    lost, found = range(40, 60), view.track.confidence.any(axis=1)
    frames = [
        [Candidate(other.track.pixels[t], other.track.confidence[t])]
        + ([Candidate(view.track.pixels[t], view.track.confidence[t])] if t not in lost and found[t] else [])
        for t in range(len(view.track))
    ]
    at = np.nanmean(view.track.pixels[0], axis=0)
    chain = np.array(follow(frames, view.track.fps, (float(at[0]), float(at[1]))))
    return {"view": view.camera.name, "woman": int((chain == 0).sum()), "nobody": int((chain == -1).sum())}
