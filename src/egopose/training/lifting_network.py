"""Training of the network that lifts 2D keypoints, on motion capture that virtual cameras project."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.humanoid.model import HumanoidModel
from egopose.motion.motion import Motion
from egopose.scene.lifting import JOINTS, LiftingNetwork
from egopose.scene.poses.keypoints import HUMANOID_JOINTS
from egopose.training.lifting_data import SightSettings, body_offsets, draw_windows, joint_parents, joint_turns

_DRAWN = 8192  # windows made at once
#: Shoulders, elbows, wrists, hips, knees, ankles: what a network is judged by.
_LIMBS = [JOINTS.index(name) for name in HUMANOID_JOINTS.values()]


@dataclass(frozen=True)
class LifterSettings:
    """``conf/lifter.yaml``, which gives the source of every value.

    Args:
        width, blocks, dropout: of :class:`~egopose.scene.lifting.LiftingNetwork`.
        epochs: every one draws bodies, cameras and errors anew.
        uses: passes over what is drawn.
        batch, learning_rate, weight_decay: of AdamW, in one cycle.
        warm_up: share of the steps in which the learning rate rises.
        bfloat16: forward passes in half precision.
        seed, threads: of all draws, and of torch.
    """

    width: int
    blocks: int
    dropout: float
    epochs: int
    uses: int
    batch: int
    learning_rate: float
    weight_decay: float
    warm_up: float
    bfloat16: bool
    seed: int
    threads: int

    def __post_init__(self) -> None:
        for name in ("width", "blocks", "epochs", "uses", "batch", "threads"):
            if getattr(self, name) < 1:
                raise InputError("lifter", name, "must be at least 1")
        if not 0 < self.warm_up < 1:
            raise InputError("lifter", "warm_up", f"is a share above 0 and below 1, got {self.warm_up}")


def train_lifting_network(
    humanoid: HumanoidModel,
    clips: Sequence[Motion],
    sight: SightSettings,
    settings: LifterSettings,
    progress: Callable[[int, float, float], None] | None = None,
) -> LiftingNetwork:
    """The trained network, in evaluation mode.

    Args:
        humanoid: the clips' body.
        clips: to learn from, at 30 frames/s.
        sight: how bodies are drawn and seen.
        settings: of the network and its training.
        progress: told epoch, mean distance of a point (body heights) and seconds after each epoch.

    Raises:
        InputError: no clip is long enough.
    """
    turns = joint_turns(clips)
    offsets, parents = body_offsets(humanoid, sight), joint_parents(humanoid.skeleton)
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        random = torch.Generator().manual_seed(settings.seed)
        network = LiftingNetwork(settings.width, settings.blocks, settings.dropout)
        total = len(turns.middles)
        batch = min(settings.batch, total)
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        steps = max(10, settings.epochs * settings.uses * (total // batch))
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, total_steps=steps, pct_start=settings.warm_up
        )
        network.train()
        for epoch in range(settings.epochs):
            began, losses = time.perf_counter(), list[float]()
            order = turns.middles[torch.randperm(total)][: total // batch * batch]
            for part in order.split(max(1, _DRAWN // batch) * batch):
                windows, target = draw_windows(turns, part, offsets, parents, sight, random)
                again = torch.cat([torch.randperm(len(windows)) for _ in range(settings.uses)])
                for chosen in again.split(batch):
                    rows, wanted = windows[chosen], target[chosen]
                    with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
                        points = network(rows)
                    loss = (points.float() - wanted).norm(dim=-1).mean()
                    optimiser.zero_grad(set_to_none=True)
                    loss.backward()
                    optimiser.step()
                    schedule.step()
                    losses.append(float(loss.detach()))
            if progress is not None:
                progress(epoch + 1, sum(losses) / len(losses), time.perf_counter() - began)
    return network.eval()


def lifting_errors(
    network: LiftingNetwork, humanoid: HumanoidModel, clips: Sequence[Motion], sight: SightSettings, seed: int
) -> dict[str, float]:
    """How far the network's limb joints are off on people that it has not seen, each window through a new camera.

    Returns:
        Mean distance in mm for a body of 1.75 m: ``network`` and ``mean pose``, which is told the heading of none.
    """
    turns = joint_turns(clips)
    offsets, parents = body_offsets(humanoid, sight), joint_parents(humanoid.skeleton)
    random = torch.Generator().manual_seed(seed)
    windows, target = draw_windows(turns, turns.middles, offsets, parents, sight, random)
    with torch.no_grad():
        points = network(windows)
    return {"network": _distance(points, target), "mean pose": _distance(target.mean(dim=0, keepdim=True), target)}


def _distance(points: Tensor, target: Tensor) -> float:
    return 1750.0 * float((points[:, _LIMBS] - target[:, _LIMBS]).norm(dim=-1).mean())
