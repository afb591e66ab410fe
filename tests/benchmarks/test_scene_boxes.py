"""``egopose bench env scene.boxes=K``: the same steps with and without boxes."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.mocap import default_humanoid

from egopose.benchmarks import env
from egopose.benchmarks.scene_boxes import box_count, compare_with_boxes
from egopose.core.errors import InputError
from egopose.humanoid.physics import BatchedPhysics


@pytest.mark.parametrize("word", ["scene.boxes=0", "scene.boxes=-1", "scene.boxes=some", "scene.boxes", "scene.box=3"])
def test_a_wrong_scene_is_an_input_error(word: str) -> None:
    with pytest.raises(InputError, match=word.partition("=")[0]):
        env.run([word], 1)


def test_the_last_word_counts() -> None:
    assert box_count([]) is None
    assert box_count(["scene.boxes=2", "scene.boxes=3"]) == 3


def test_every_kind_takes_the_recorded_steps_and_stands_on_its_box(monkeypatch) -> None:
    """Raised onto a box, a body in the recorded state touches it with both feet, and nothing diverges."""
    humanoid = default_humanoid(2)
    model = humanoid.mj_model
    physics = BatchedPhysics(model, 3, humanoid.substeps, body_ids=humanoid.body_ids)
    qpos = np.tile(model.qpos0, (3, 1))
    qpos[:, 2], qpos[:, 0] = 0.0222 + 0.4767 + 0.4982 + 0.075, [0.0, 4.0, -7.0]
    physics.set_state(slice(None), qpos, np.zeros((3, model.nv)))
    ctrl = np.zeros((3, model.nu))
    states = []
    for _ in range(4):
        states.append(physics.state.copy())
        physics.step(ctrl)
    taken, step = [], BatchedPhysics.step

    def spy(self: BatchedPhysics, ctrl: np.ndarray) -> np.ndarray:
        before = self.qpos[:, 2].copy()
        stopped = step(self, ctrl)
        assert not stopped.any()
        taken.append((self.model.nmocap, before, self.body_state()))
        return stopped

    monkeypatch.setattr(BatchedPhysics, "step", spy)
    result = compare_with_boxes(humanoid, 3, states, [ctrl] * 4, threads=1, rounds=1)
    assert result["boxes"] == 3
    assert set(result) == {"boxes"} | {
        f"box{told}_ratio{of}" for told in ("", "_contacts_torques") for of in ("", "_wall")
    }
    assert all(value > 0 for value in result.values())
    assert [boxes for boxes, *_ in taken] == ([0] * 4 + [3] * 8) * 2  # a round to warm up
    bare, among, told = taken[3], taken[7], taken[11]
    np.testing.assert_allclose(among[1] - bare[1], 0.3)
    np.testing.assert_allclose(among[2]["qpos"][:, 7:], bare[2]["qpos"][:, 7:], atol=0.02)
    feet = [humanoid.skeleton.names[i].endswith("Foot") for i in humanoid.end_effectors]
    assert told[2]["box_contacts"][:, feet, 0].all()
    assert not told[2]["floor_contacts"].any()
    assert told[2]["torques"].any()
