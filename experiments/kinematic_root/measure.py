"""How far the kinematic root is off on mocap: python experiments/kinematic_root/measure.py CMU_PEOPLE [NETWORK]."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.checkpoint.contacts import load_contact_network
from egopose.core.config import compose_config, from_mapping
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import low_pass
from egopose.data.reference import reference_states
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget
from egopose.pipeline.mocap_sources import clips_of
from egopose.scene.contacts import ContactEstimator
from egopose.scene.root import KinematicRoot, kinematic_root
from egopose.training.contact_clips import ContactSettings, contact_clip, seen_by

STEPS = ("14_21", "14_22", "14_23")  # "climb 3 steps", with the root as recorded


def root_of(
    humanoid: HumanoidModel, motion: Motion, contacts: np.ndarray, noise: float, rng: np.random.Generator
) -> KinematicRoot:
    """From the motion's joints relative to its pelvis alone, each with ``noise`` (m an axis) that is then smoothed."""
    pelvis = motion.qpos[:, :3]
    feet = (sole_positions(humanoid, motion) - pelvis[:, None]).reshape(len(pelvis), 2, 2, 3)
    com = reference_states(humanoid, motion)["com"].numpy() - pelvis
    if noise:
        # Half a tenth of a second of smoothing: what inverse kinematics in time does to noise.
        feet = gaussian_filter1d(feet + rng.normal(scale=noise, size=feet.shape), 1.5, axis=0)
    return kinematic_root(feet, contacts, com, motion.fps)


def row(motion: Motion, root: KinematicRoot) -> dict[str, float]:
    """Mean and final distance in % of the path, and the path, m."""
    truth = motion.qpos[:, :3] - [*motion.qpos[0, :2], 0.0]
    path = float(np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1).sum())
    error = np.linalg.norm(root.positions - truth, axis=1)
    return {"mean_percent": 100 * error.mean() / path, "end_percent": 100 * error[-1] / path, "path": path}


def steps(humanoid: HumanoidModel, folder: Path) -> dict[str, dict[str, list[float]]]:
    """Heights of the supports as recorded and as read off the joints, of the clips that climb three steps."""
    out = {}
    for name in STEPS:
        source = read_motion(folder / "cmu_cgspeed_daz" / f"{name}.bvh")
        source = source.slice(4, len(source)).resample(30.0)
        motion = low_pass(retarget(source, humanoid.skeleton, humanoid.joint_range)[0], 8.0)
        soles = sole_positions(humanoid, motion)
        # The floor is not flat here: a foot that is slow touches something.
        speed = np.linalg.norm(np.gradient(soles, axis=0), axis=2) * motion.fps
        contacts = (speed < 0.3).reshape(len(motion), 2, 2).any(axis=2)
        root = root_of(humanoid, motion, contacts, 0.0, np.random.default_rng(0))
        lowest = soles[..., 2].reshape(len(motion), 2, 2).min(axis=2)
        true = [float(np.median(lowest[s.start : s.stop, s.foot])) for s in root.supports]
        out[name] = {
            "recorded": [round(height - true[0], 3) for height in true],
            "read_off": [round(s.height, 3) for s in root.supports],
            "frames": [s.stop - s.start for s in root.supports],
            **{key: [round(float(value), 2)] for key, value in row(motion, root).items()},
        }
    return out


def main() -> None:
    """Print a line a clip; write result.json beside this file."""
    folder = Path(sys.argv[1])
    values = compose_config("contacts", [f"sources.cmu_people={folder}", "out=unused"])
    settings = from_mapping(ContactSettings, values["training"], "conf/contacts.yaml")
    humanoid = humanoid_of(values)
    network: ContactEstimator | None = load_contact_network(Path(sys.argv[2])) if len(sys.argv) > 2 else None
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for place, motion in enumerate(clips_of(values, "conf/contacts.yaml")[1]):
        clip = contact_clip(humanoid, motion, settings)
        cases = {"true contacts": (clip.contacts, 0.0), "true contacts, 30 mm": (clip.contacts, 0.03)}
        if network is not None:
            seen = seen_by(clip, "pan", settings, np.random.default_rng([7, place]))
            told = network.probabilities(seen.keypoints, seen.confidence, seen.camera) > 0.5
            cases |= {"network's contacts": (told, 0.0), "network's contacts, 30 mm": (told, 0.03)}
        for name, (contacts, noise) in cases.items():
            if contacts.any():
                root = root_of(humanoid, motion, contacts, noise, np.random.default_rng(place))
                rows.setdefault(name, {})[motion.name] = row(motion, root)
    summary = {}
    for name, clips in rows.items():
        mean, path = (np.array([clip[key] for clip in clips.values()]) for key in ("mean_percent", "path"))
        summary[name] = {"median": float(np.median(mean)), "pooled": float((mean * path).sum() / path.sum())}
        print(f"{name}: median {summary[name]['median']:.1f} %, pooled {summary[name]['pooled']:.1f} % of the path")
    result = {"summary": summary, "steps": steps(humanoid, folder), "per_clip": rows}
    for name, heights in result["steps"].items():
        print(name, heights)
    (Path(__file__).parent / "result.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
