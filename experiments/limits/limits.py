"""What limits E_pose: how far the true places of the wearer's limbs, told to the kernels, would take them.

    python experiments/limits/limits.py data.folder=PATH/cmu_bvh60

On held-out blocks of each subject's training frames (no test frame is looked at), the kernels of `regressor=blended`
learn and answer from what the limb finder says, and from the truth in its stead. README.md is written beside this file.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from egopose.core.atomic_write import write_text_whole
from egopose.core.config import compose_config, from_mapping
from egopose.data.preparation import flow_name, global_spans, humanoid_of, prepare
from egopose.data.spans import Span, cross_fit_blocks, without_block
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.evaluation.metrics import pose_error
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.blended import MeanOfKernels
from egopose.models.mirror import state_mirror
from egopose.models.regressor import state_statistics
from egopose.motion.rotations import Array
from egopose.pipeline.dataset import absolute_paths
from egopose.pipeline.regressor_input import load_body_part_estimator_of, seen_in_store
from egopose.training.blended_regressor import (
    KernelSettings,
    fit_kernels,
    importance_of,
    mirrored_view,
    view_table,
    windowed,
)
from egopose.vision.body_part_pictures import BODIES, posture_in
from egopose.vision.body_parts import LOG_VARIANCE, BodyPartEstimator
from egopose.vision.mounts import WEARER_CAMERA, camera_orientations
from egopose.vision.rendering import worn_camera
from egopose.vision.takes import RenderConfig, take_seed

HERE = Path(__file__).resolve().parent
SUBJECTS = ("2", "5", "7")
PLACES = 3 * len(BODIES)  # numbers at a posture's begin; the four after it are the camera's
HEAD = (
    "# What limits E_pose",
    "",
    "*Written by `limits.py`; do not edit.* E_pose (rad, mean over frames) of the kernels of `regressor=blended` on",
    "held-out blocks of each subject's training frames of `cmu6`, where the limb finder's answers are replaced by the",
    "truth, in training and in answering. Flow stays as it is. No test frame is looked at.",
    "",
    "```bash",
    "python experiments/limits/limits.py data.folder=PATH/cmu_bvh60",
    "```",
    "",
    "| beside flow the kernels are told | " + " | ".join(f"subject {subject}" for subject in SUBJECTS) + " |",
    "| --- |" + " ---: |" * len(SUBJECTS),
)
TAIL = (
    "A finder that knew exactly where every hand, elbow, knee and foot in the picture is would gain 2 to 5 %, and one",
    "that knew where those outside of it are as well, 13 or 14 %: the rest is which joint angles hold a hand or a foot",
    "in its place, which minutes of one person's motion do not tell.",
)


def true_postures(config: dict[str, Any], store: TakeStore, humanoid: HumanoidModel) -> tuple[Tensor, Tensor]:
    """Postures ``[F, Q]`` as finders give them, in their own units, and which bodies ``[F, B]`` lie in the picture."""
    render = RenderConfig.from_mapping(config["vision"])
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    data, camera = mujoco.MjData(model), model.camera(WEARER_CAMERA).id
    postures, inside = [], []
    for index, take in enumerate(store.takes):
        qpos = store.clip(index).qpos
        worn, angles = worn_camera(take_seed(take.name), len(qpos), render.fps, render.camera)
        reach = np.tan(np.deg2rad(worn.field_of_view) / 2)
        for pose, mounted in zip(qpos, camera_orientations(model, angles), strict=True):
            model.cam_quat[camera], data.qpos[:] = mounted, pose
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            postures.append(posture_in(model, data))
            places = postures[-1][:PLACES].reshape(-1, 3)  # x right, y up, z back
            inside.append((np.abs(places[:, :2]) < -places[:, 2:] * reach).all(axis=1))
    return torch.from_numpy(np.stack(postures)), torch.from_numpy(np.stack(inside))


def with_truth(rows: Tensor, truth: Tensor, known: Tensor) -> Tensor:
    """A finder's rows ``[F, 2 Q]`` with the ``known`` ``[F, Q]`` numbers true, and sure."""
    posture, log_variance = rows.chunk(2, dim=1)
    return torch.cat([torch.where(known, truth, posture), log_variance.masked_fill(known, LOG_VARIANCE[0])], dim=1)


def told(rows: Tensor, postures: Tensor, inside: Tensor, finder: BodyPartEstimator) -> dict[str, Tensor]:
    """What the kernels are given beside flow, by what is said of it in the table."""
    truth = (postures - finder.mean) / finder.std
    nothing = torch.zeros_like(truth, dtype=torch.bool)
    in_view, camera, everywhere = nothing.clone(), nothing.clone(), nothing.clone()
    in_view[:, :PLACES] = inside.repeat_interleave(3, dim=1)
    camera[:, PLACES : PLACES + 4] = True
    everywhere[:, : PLACES + 4] = True
    known = {
        "what the finder says": nothing,
        "the way up and the camera's height, true": camera,
        "places of the bodies whose centres lie in the picture, true": in_view,
        "both": in_view | camera,
        "places of all eleven bodies, seen or not, and the camera's": everywhere,
    }
    return {name: with_truth(rows, truth, mask) for name, mask in known.items()}


def held_out_error(
    views: Tensor,
    states: Tensor,
    fragments: list[Span],
    takes: list[Span],
    regressor: Mapping[str, Any],
    settings: KernelSettings,
    humanoid: HumanoidModel,
) -> float:
    """E_pose (rad) of the kernels' mean on cross-fitted blocks of ``fragments``.

    Args:
        views: what the kernels see of each frame ``[F, V]``.
        states: ``[F, S]`` the true ones.
        fragments: training frames.
        takes: each a clip by itself.
        regressor: the group of that name, blended.
        settings: of its kernels.
        humanoid: whose states they are.
    """
    mean, std = state_statistics(states[_frames(fragments)], float(regressor["std_floor"]))
    mirrored = state_mirror(humanoid.skeleton).state(states)
    table, image = windowed(views, takes, settings), windowed(mirrored_view(views, settings), takes, settings)
    wanted, wanted_image = (((z - mean) / std).float() for z in (states, mirrored))
    margin, hands, errors = int(regressor["margin"]), humanoid.hand_dofs.tolist(), []
    for block in cross_fit_blocks(fragments, int(regressor["cross_fit"])):
        others = without_block(fragments, block, margin, margin)
        kernels = fit_kernels(table, wanted, others, settings, importance_of(humanoid, std), (image, wanted_image))
        frames = _frames(block)
        answer = MeanOfKernels(kernels)(table[frames]) * std + mean
        errors.append(pose_error(_as_qpos(answer, humanoid), _as_qpos(states[frames], humanoid), hands))
    return float(np.concatenate(errors).mean())


def _frames(spans: list[Span]) -> Tensor:
    return torch.cat([torch.arange(span.start, span.stop) for span in spans])


def _as_qpos(states: Tensor, humanoid: HumanoidModel) -> Array:
    """States z ``[T, S]`` as coordinates ``[T, nq]`` of a body that stands over the origin."""
    layout = StateLayout.of_size(states.shape[1])
    poses = [states[:, part].double().numpy() for part in (layout.root_pose, layout.joint_angles)]
    return np.concatenate([np.zeros((len(states), 2)), *poses], axis=1)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="+", help="of the configuration; data.folder=PATH is needed")
    words = ["data=cmu6", "regressor=blended", *parser.parse_args().overrides]
    config = absolute_paths(compose_config("train", words))
    regressor = config["regressor"]
    store, humanoid, finder = prepare(config), humanoid_of(config), load_body_part_estimator_of(regressor)
    assert finder is not None
    takes = [Span(t.offset, t.offset + t.length) for t in store.takes]
    settings = from_mapping(KernelSettings, regressor["kernel"], "conf/regressor kernel")
    seen = seen_in_store(config, regressor, store, flow_name(config))
    table = view_table(seen, takes, settings, int(regressor["encode_batch"]))
    flow, rows = table.split([table.shape[1] - settings.limb_numbers, settings.limb_numbers], dim=1)
    states = humanoid_state(store.reference)
    lines = []
    for name, given in told(rows, *true_postures(config, store, humanoid), finder).items():
        cells, views = [], torch.cat([flow, given], dim=1)
        for subject in SUBJECTS:
            split = {**config["data"]["split"], "subjects": [subject]}
            pieces = split_takes(store.takes, split, "train", supported_only=False)
            fragments = [Span(*span) for span in global_spans(store, pieces)]
            error = held_out_error(views, states, fragments, takes, regressor, settings, humanoid)
            cells.append(f"{error:.3f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    write_text_whole(HERE / "README.md", "\n".join([*HEAD, *lines, "", *TAIL, ""]))


if __name__ == "__main__":
    main()
