"""Draw the pictures of the docs from the program itself: ``python docs/pictures/make.py``.

All are made of clips that come with the package:

- CMU 07_04, a walk: the body driven by PD alone beside the mocap, and the rendered view with its optical flow.
- CMU 07_05, a walk: what the pretrained weights make of the rendered video.
- DeepMimic's cartwheel: how fast head and camera turn.

One more picture shows the way of the data through the program.
"""

from __future__ import annotations

import tempfile
from importlib.resources import files
from pathlib import Path

import cv2
import matplotlib
import mujoco
import numpy as np
from PIL import Image

from egopose.core.config import compose_config
from egopose.data.gate import LEAD
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import reference_motion
from egopose.data.reference import reference_states
from egopose.data.sync_offset import head_turning
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.video import estimate_video
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.flow import FlowConfig, flow_image, flow_of_frames
from egopose.vision.rendering import SceneRenderer, wearer_frames
from egopose.vision.rooms import room_seed
from egopose.vision.side_by_side import side_by_side
from egopose.vision.takes import RenderConfig
from egopose.vision.video import write_video

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
CLIPS = Path(str(files("egopose") / "assets" / "clips"))
PRETRAINED = "pretrained:people_estimation"
SHOWN = (12, 16, 20, 24)  # frames of the clip, 1/30 s each: steps of the walk


def save(name: str, picture: np.ndarray) -> None:
    """An RGB picture as JPEG."""
    cv2.imwrite(str(HERE / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


def driven(humanoid: HumanoidModel, clip: Motion, start: int, stop: int) -> np.ndarray:
    """``[stop - start, nq]``: physics from the clip's state at ``start``, PD towards its joint angles."""
    states = reference_states(humanoid, clip)
    qpos, qvel = states["qpos"].numpy(), states["qvel"].numpy()
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps, 1, body_ids=humanoid.body_ids)
    physics.set_state(np.arange(1), qpos[[start]], qvel[[start]])
    poses = [qpos[start]]
    for frame in range(start + 1, stop):
        physics.step(np.ascontiguousarray(qpos[[frame], 7:] + LEAD * qvel[[frame], 6:]))
        poses.append(physics.qpos[0].copy())
    physics.close()
    return np.stack(poses)


def bodies(humanoid: HumanoidModel, clip: Motion) -> None:
    """The mocap's poses above, the simulated body's below."""
    simulated = driven(humanoid, clip, SHOWN[0], SHOWN[-1] + 1)
    view = mujoco.MjvCamera()
    view.type, view.distance, view.elevation, view.azimuth = mujoco.mjtCamera.mjCAMERA_FREE, 2.6, -8.0, 120.0
    rows = []
    with SceneRenderer(humanoid.mj_model, 260, 320) as renderer:
        for poses in ([clip.qpos[f] for f in SHOWN], [simulated[f - SHOWN[0]] for f in SHOWN]):
            panels = []
            for pose in poses:
                view.lookat = [pose[0], pose[1], 0.85]
                panels.append(renderer.render(pose, view))
            rows.append(np.concatenate(panels, axis=1))
    save("walk.jpg", np.concatenate(rows))


def filmed(humanoid: HumanoidModel, clip: Motion, size: int) -> tuple[list[np.ndarray], np.ndarray]:
    """The wearer's frames ``[size, size, 3]`` and their flow ``[T, 2, 32, 32]``."""
    settings = RenderConfig.from_mapping(compose_config("prepare")["vision"])
    seed = room_seed(clip.name, "train", settings.room)
    places = {"room": settings.room, "camera": settings.camera, "size": size, "fps": settings.fps}
    frames = list(wearer_frames(humanoid.xml, clip.qpos, room_seed=seed, take_seed=7, **places))
    return frames, np.stack(list(flow_of_frames(frames, FlowConfig("medium", 128, 32, 1))))


def seen(humanoid: HumanoidModel, clip: Motion) -> None:
    """The wearer's view above its flow."""
    frames, flow = filmed(humanoid, clip, 256)
    views = np.concatenate([frames[f] for f in SHOWN], axis=1)
    flows = np.concatenate([flow_image(flow[f], 0.03, 256) for f in SHOWN], axis=1)
    save("wearers_view.jpg", np.concatenate([views, flows]))


def estimated(humanoid: HumanoidModel, clip: Motion) -> None:
    """A moving picture: the mocap, what the pretrained weights estimate from the video, and the rendered video."""
    frames, _ = filmed(humanoid, clip, 256)
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "wearer.mp4"
        write_video(video, frames, 30.0)
        out = estimate_video(compose_config("estimate", [f"video={video}", f"checkpoint={PRETRAINED}"]))
        found = read_motion(out / "estimate.npz")
    motions = {"motion capture": clip.qpos, "estimate": found.qpos}
    panels = side_by_side(humanoid.mj_model, motions, frames, "rendered video", 240)
    pictures = [Image.fromarray(panel) for panel in list(panels)[:100:2]]
    pictures[0].save(
        HERE / "estimate.webp", save_all=True, append_images=pictures[1:], duration=67, loop=0, quality=70, method=6
    )


def turning(humanoid: HumanoidModel, clip: Motion) -> None:
    """How fast head and camera turn."""
    _, flow = filmed(humanoid, clip, 128)
    head, camera = head_turning(clip, 30.0), 30.0 * camera_rotation(flow[1:], 102.5)
    figure, axis = plt.subplots(figsize=(7.5, 2.8))
    for turns, label in ((head, "head, from the motion"), (camera, "camera, from optical flow")):
        axis.plot((np.arange(len(turns)) + 0.5) / 30, np.linalg.norm(turns, axis=1), label=label)
    axis.set(xlabel="s", ylabel="angular speed, rad/s")
    axis.legend()
    figure.tight_layout()
    figure.savefig(HERE / "turning.png", dpi=90)
    plt.close(figure)


def way() -> None:
    """Boxes and arrows: from files to a motion."""
    boxes = {
        "motion files\nBVH AMC npz": (0.0, 1.0),
        "wearer's MP4": (0.0, 0.0),
        "retarget, align\nto the floor": (1.0, 1.0),
        "optical flow": (1.0, 0.0),
        "take store": (2.0, 0.5),
        "state regressor F\n(video to state)": (3.0, 0.0),
        "PPO in MuJoCo\n(reward: mocap)": (3.0, 1.0),
        "checkpoint": (4.0, 0.5),
        "estimate:\nvideo to motion": (5.0, 0.0),
        "evaluate:\nfigures, pictures": (5.0, 1.0),
    }
    arrows = ((0, 2), (1, 3), (2, 4), (3, 4), (4, 5), (4, 6), (5, 6), (6, 7), (5, 7), (7, 8), (7, 9))
    figure, axis = plt.subplots(figsize=(9.6, 2.4))
    patches = []
    for label, (x, y) in boxes.items():
        frame = {"boxstyle": "round,pad=0.4", "facecolor": "#e8eefc", "edgecolor": "#3f51b5"}
        text = axis.text(x, y, label, ha="center", va="center", fontsize=8, bbox=frame)
        patches.append((text.get_bbox_patch(), (x, y)))
    axis.set(xlim=(-0.5, 5.5), ylim=(-0.5, 1.5))
    axis.axis("off")
    figure.canvas.draw()  # boxes have their sizes only now
    for tail, head in arrows:
        ends = {"patchA": patches[tail][0], "patchB": patches[head][0], "shrinkA": 0, "shrinkB": 2}
        style = {"arrowstyle": "->", "color": "#555555", **ends}
        axis.annotate("", patches[head][1], patches[tail][1], arrowprops=style)
    figure.tight_layout()
    figure.savefig(HERE / "way.svg", metadata={"Date": None})


def main() -> None:
    """All of them."""
    humanoid = humanoid_of(compose_config("prepare"))
    walk, longer, wheel = (
        reference_motion(read_motion(CLIPS / f"{name}.motion.npz"), humanoid)[0]
        for name in ("cmu07_04", "cmu07_05", "deepmimic_cartwheel")
    )
    bodies(humanoid, walk)
    seen(humanoid, walk)
    estimated(humanoid, longer)
    turning(humanoid, wheel)
    way()


if __name__ == "__main__":
    main()
