"""What boxes in the worlds cost a step of physics, and what telling contacts and joint torques costs beside them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from egopose.core.errors import InputError
from egopose.humanoid.boxes import with_boxes
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import ALL, Array, BatchedPhysics

_HEIGHT = 0.3  # m: of the box that carries the body
_FACE, _OTHERS = (2.0, 2.0), (0.5, 0.5)  # m: the floor in the place of which it carries, and those within reach
_REACH = 1.4  # m from the body to the others' middles: beside the first box, where a fall or a long step meets them


def box_count(words: Sequence[str]) -> int | None:
    """K of ``scene.boxes=K`` among the ``scene.`` overrides; None without any.

    Raises:
        InputError: another name, or not a positive whole number.
    """
    count = None
    for word in words:
        name, _, value = word.partition("=")
        if name != "scene.boxes":
            raise InputError("egopose bench env", name, "is no setting; scene.boxes=K adds K boxes to the worlds")
        if not value.isdecimal() or int(value) < 1:
            raise InputError("egopose bench env", name, f"{value!r} is not a number of boxes; 3 is usual")
        count = int(value)
    return count


def compare_with_boxes(
    humanoid: HumanoidModel, count: int, states: Sequence[Array], ctrls: Sequence[Array], threads: int, rounds: int
) -> dict[str, float | int]:
    """The same control steps on the floor, among boxes, and among boxes with contacts and torques told, turn about.

    Every world's body stands on its first box, raised by its height, and the others are within reach: as many contacts
    as on the floor, but with a box's faces. Steps begin at recorded states, so that all three do the same work.

    Args:
        humanoid: without boxes.
        count: K.
        states: of each control step, ``[N, nstate]`` without boxes.
        ctrls: ``[N, nu]`` of each.
        threads: of the physics.
        rounds: the median counts.

    Returns:
        ``boxes``; ``box_ratio``, the bare step's processor time over that with boxes; ``box_contacts_torques_ratio``,
        over that with boxes, contacts and torques; both with ``_wall`` by the clock, which other programs disturb more.
    """
    scene = with_boxes(humanoid, [_FACE, *[_OTHERS] * (count - 1)])
    sizes = len(ctrls[0]), humanoid.substeps, threads
    among = partial(BatchedPhysics, scene.mj_model, *sizes, body_ids=humanoid.body_ids)
    kinds = {
        "bare": BatchedPhysics(humanoid.mj_model, *sizes, body_ids=humanoid.body_ids),
        "box": among(),
        "box_contacts_torques": among(contacts=True, torques=True),
    }
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
    for turn in range(rounds + 1):
        for name, physics in kinds.items():
            spent = _seconds(physics, 0 if name == "bare" else count, states, ctrls)
            if turn:  # the first warms up
                seconds[name].append(spent)
    for physics in kinds.values():
        physics.close()
    out: dict[str, float | int] = {"boxes": count}
    for name in ("box", "box_contacts_torques"):
        pairs = list(zip(seconds["bare"], seconds[name], strict=True))
        out[f"{name}_ratio"] = statistics.median(bare[1] / those[1] for bare, those in pairs)
        out[f"{name}_ratio_wall"] = statistics.median(bare[0] / those[0] for bare, those in pairs)
    return out


def _seconds(
    physics: BatchedPhysics, count: int, states: Sequence[Array], ctrls: Sequence[Array]
) -> tuple[float, float]:
    """By the clock and of the processor, of the steps alone."""
    wall = cpu = 0.0
    angle = np.linspace(0.0, 2.0 * np.pi, max(count - 1, 1), endpoint=False)
    around = np.concatenate([np.zeros((1, 2)), _REACH * np.stack([np.cos(angle), np.sin(angle)], axis=-1)])[:count]
    for state, ctrl in zip(states, ctrls, strict=True):
        physics.state[:, : state.shape[1]] = state
        if count:
            top = np.full((len(state), count, 3), _HEIGHT)
            top[..., :2] = physics.qpos[:, None, :2] + around
            physics.place_boxes(ALL, top, np.zeros((len(state), count)))
            physics.qpos[:, 2] += _HEIGHT
        began, began_cpu = time.perf_counter(), time.process_time()
        physics.step(ctrl)
        wall, cpu = wall + time.perf_counter() - began, cpu + time.process_time() - began_cpu
    return wall, cpu
