"""Bringing a body closer to its reference: what comes out plays again to the bit, and bad settings are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.clip_folder import clip_folder

from egopose.checkpoint.pretrained import FOLDER
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.window_refinement import Reference, RefinementSettings, WindowRefiner
from egopose.motion.rotations import Array
from egopose.pipeline.agent import load_policy
from egopose.scene.clip import read_clip
from egopose.scene.simulated import SimulatedMotion

FRAMES = 14
SMALL = {"window": 12, "knots": 3, "changed": 6, "advance": 3, "iterations": 2, "threads": 1}


def settings(**more: Any) -> RefinementSettings:
    return RefinementSettings.from_config({**compose_config("reconstruct")["refinement"], **SMALL, **more})


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_of(compose_config("reconstruct"))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory, humanoid: HumanoidModel) -> tuple[Array, Array]:
    states = reference_states(humanoid, read_clip(clip_folder(tmp_path_factory.mktemp("walk"), None, FRAMES)).body)
    return states["qpos"].numpy(), states["qvel"].numpy()


def refiner(humanoid: HumanoidModel, walk: tuple[Array, Array], chosen: RefinementSettings) -> WindowRefiner:
    qpos, qvel = walk
    tracker = ReferenceTracker(load_policy(FOLDER / "tracker"), humanoid, qpos, qvel)
    reference = Reference(qpos, qvel, np.ones(FRAMES), np.zeros((0, 3)), np.zeros(0))
    return WindowRefiner(humanoid, tracker, reference, chosen)


def tracked(humanoid: HumanoidModel, walk: tuple[Array, Array]) -> SimulatedMotion:
    """What the tracker does by itself."""
    tracker = ReferenceTracker(load_policy(FOLDER / "tracker"), humanoid, *walk)
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps)
    physics.set_state([0], walk[0][:1], walk[1][:1])
    qpos, qvel, ctrl = [walk[0][0]], [walk[1][0]], []
    for frame in range(FRAMES - 1):
        ctrl.append(tracker.targets(frame, physics.qpos, physics.qvel))
        physics.step(ctrl[-1])
        qpos.append(physics.qpos[0].copy())
        qvel.append(physics.qvel[0].copy())
    physics.close()
    return SimulatedMotion(np.stack(qpos), np.stack(qvel), np.concatenate(ctrl), np.zeros((0, 3)), np.zeros(0))


def test_a_sweep_brings_the_body_closer_and_plays_again_to_the_bit(
    humanoid: HumanoidModel, walk: tuple[Array, Array]
) -> None:
    closer = refiner(humanoid, walk, settings())
    before = tracked(humanoid, walk)
    done: list[int] = []
    motion, offsets = closer.refine(walk[0][0], walk[1][0], advance=done.append)
    assert closer.cost(motion) < 0.7 * closer.cost(before)
    assert sum(done) == FRAMES - 1
    assert offsets.shape == motion.ctrl.shape
    again, _ = closer.refine(walk[0][0], walk[1][0], offsets)
    assert closer.cost(again) < 1.05 * closer.cost(motion)
    closer.close()
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps)
    physics.set_state([0], motion.qpos[:1], motion.qvel[:1])
    for frame, ctrl in enumerate(motion.ctrl):
        physics.step(ctrl[None])
        np.testing.assert_array_equal(physics.qpos[0], motion.qpos[frame + 1])
    physics.close()


def test_threads_change_nothing(humanoid: HumanoidModel, walk: tuple[Array, Array]) -> None:
    both = []
    for threads in (1, 2):
        one = refiner(humanoid, walk, settings(threads=threads))
        both.append(one.refine(walk[0][0], walk[1][0])[0].qpos)
        one.close()
    np.testing.assert_array_equal(*both)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("window", 0),
        ("changed", 13),
        ("advance", 7),
        ("sweeps", 0),
        ("difference", 0.0),
        ("reach", -1.0),
        ("dampings", []),
    ],
)
def test_a_setting_that_cannot_be_is_named(name: str, value: object) -> None:
    with pytest.raises(InputError, match=name):
        settings(**{name: value})


def test_an_unknown_weight_is_named(tmp_path: Path) -> None:
    weights = {**compose_config("reconstruct")["refinement"]["weights"], "luck": 1.0}
    with pytest.raises(InputError, match="luck"):
        settings(weights=weights)
