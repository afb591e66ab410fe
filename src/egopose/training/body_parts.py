"""Training of the body-part estimator on drawn pictures: loss, loop, held-out figures, what is kept.

Masks by binary cross-entropy, postures by the likelihood of a normal distribution whose variance is learned with it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, metadata_of, read_json
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.models.mirror import StateMirror, joint_mirror
from egopose.motion.skeleton import Skeleton
from egopose.vision.body_part_pictures import BODIES, posture_names
from egopose.vision.body_parts import LIMBS, BodyPartEstimator
from egopose.vision.flow import FlowConfig

State = dict[str, Tensor]
#: The limbs of the mirror image, in :data:`egopose.vision.body_parts.LIMBS`' order.
_LIMB_MIRROR = [1, 0, 3, 2, 4]


@dataclass(frozen=True)
class BodyPartSettings:
    """The group ``training`` of ``conf/body_parts.yaml``.

    Args:
        channels: of the finder's convolutions.
        epochs: passes over the training pictures; a part of one counts.
        batch: pictures a step.
        held_out: share of the pictures, the last ones, that is not trained on.
        learning_rate: AdamW's, after ``warm_up``; a cosine takes it to nothing at the end.
        warm_up: steps in which the learning rate rises from nothing.
        weight_decay: AdamW's.
        gradient_clip: norm.
        mask_weight: of the masks' loss beside the posture's.
        gain, offset: standard deviation of a picture's contrast (factor) and brightness (of half the range).
        least_deviation: of a posture's number over the pictures (m, rad): one that hardly moves is not blown up.
        bfloat16: forward passes in half precision.
        save_every: steps between saves to go on from.
        threads: of torch.
    """

    channels: int
    epochs: float
    batch: int
    held_out: float
    learning_rate: float
    warm_up: int
    weight_decay: float
    gradient_clip: float
    mask_weight: float
    gain: float
    offset: float
    least_deviation: float
    bfloat16: bool
    save_every: int
    threads: int

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> BodyPartSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        source = "conf/body_parts.yaml: training"
        settings = from_mapping(cls, values, source)
        for name in ("batch", "warm_up", "save_every", "threads"):
            if getattr(settings, name) < 1:
                raise InputError(
                    "conf/body_parts.yaml: training", name, f"must be at least 1, not {getattr(settings, name)}"
                )
        if settings.channels < 8 or settings.channels % 8:
            raise InputError(
                "conf/body_parts.yaml: training", "channels", f"must be a multiple of 8, not {settings.channels}"
            )
        if not settings.epochs > 0:
            raise InputError(source, "epochs", f"must be more than 0, not {settings.epochs}")
        if not 0.0 < settings.held_out < 1.0:
            raise InputError(source, "held_out", f"must lie in 0..1, not {settings.held_out}")
        return settings


@dataclass(frozen=True)
class Pictures:
    """Drawn pictures, as ``vision.limb_pictures`` keeps them.

    ``pictures [N, 6, 64, 64]`` uint8 (RGB of the earlier frame, then of the later), ``flow [N, 2, 32, 32]`` float16 in
    image widths a frame, ``masks [N, 5, 32, 32]`` uint8, ``posture [N, Q]`` float32.
    """

    pictures: Tensor
    flow: Tensor
    masks: Tensor
    posture: Tensor

    def __len__(self) -> int:
        return len(self.pictures)

    def rows(self, rows: Tensor | slice) -> Pictures:
        """Some of them."""
        return Pictures(self.pictures[rows], self.flow[rows], self.masks[rows], self.posture[rows])


def posture_mirror(skeleton: Skeleton) -> StateMirror:
    """The posture ``[..., Q]`` of the mirrored scene: sides change places, the camera's x changes its sign."""
    swapped = {"Left": "Right", "Right": "Left"}
    opposite = [
        BODIES.index(next((body.replace(a, b) for a, b in swapped.items() if a in body), body)) for body in BODIES
    ]
    bodies = [3 * body + axis for body in opposite for axis in range(3)]
    joints, joint_sign = joint_mirror(skeleton)
    here = 3 * len(BODIES)
    index = np.concatenate([bodies, here + np.arange(4), here + 4 + joints])
    sign = np.concatenate([np.tile([-1.0, 1.0, 1.0], len(BODIES)), [-1.0, 1.0, 1.0, 1.0], joint_sign])
    return StateMirror(torch.as_tensor(index), torch.as_tensor(sign, dtype=torch.float32))


def mirrored(sample: Pictures, mirror: StateMirror) -> Pictures:
    """The mirror image of the scene, as the mirrored camera sees it."""
    return Pictures(
        sample.pictures.flip(-1),
        mirror.flow(sample.flow),
        sample.masks[:, _LIMB_MIRROR].flip(-1),
        mirror.state(sample.posture),
    )


def varied(sample: Pictures, mirror: StateMirror, settings: BodyPartSettings, generator: torch.Generator) -> Pictures:
    """What else the sample could have been: half of it mirrored, the colours of all changed about, each one's contrast
    and brightness another. The pictures come back as float32.
    """
    flip = torch.rand(len(sample), generator=generator) < 0.5
    image = mirrored(sample, mirror)

    def either(mine: Tensor, theirs: Tensor) -> Tensor:
        return torch.where(flip.view(-1, *[1] * (mine.dim() - 1)), theirs, mine)

    colours = torch.randperm(3, generator=generator)
    pictures = either(sample.pictures, image.pictures)[:, torch.cat([colours, colours + 3])].float() / 127.5 - 1.0
    gain, offset = torch.randn(2, len(sample), 1, 1, 1, generator=generator)
    pictures = pictures * (1.0 + settings.gain * gain) + settings.offset * offset
    return Pictures(
        (pictures + 1.0) * 127.5,
        either(sample.flow, image.flow),
        either(sample.masks, image.masks),
        either(sample.posture, image.posture),
    )


def body_part_loss(model: BodyPartEstimator, sample: Pictures, mask_weight: float, bfloat16: bool) -> Tensor:
    """Cross-entropy of the masks times its weight, and the posture's negative log likelihood a number."""
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        masks, posture, log_variance = model(sample.pictures[:, :3], sample.pictures[:, 3:], sample.flow)
    truth = (sample.posture - model.mean) / model.std
    posture, log_variance = posture.float(), log_variance.float()
    likelihood = 0.5 * ((posture - truth) ** 2 * torch.exp(-log_variance) + log_variance).mean()
    shares = sample.masks.float() / 255.0
    return mask_weight * functional.binary_cross_entropy_with_logits(masks.float(), shares) + likelihood


class BodyPartTraining:
    """A training under way: the model, its optimiser and the number of steps, as flat tensors to go on from.

    Args:
        data: the pictures trained on, without those held out.
        skeleton: of the postures.
        settings: see :class:`BodyPartSettings`.
        seed: of the first weights and of every draw.
    """

    def __init__(self, data: Pictures, skeleton: Skeleton, settings: BodyPartSettings, seed: int) -> None:
        if len(data) < settings.batch:
            cause = f"is {settings.batch}, and there are {len(data)} pictures to train on"
            raise InputError("conf/body_parts.yaml: training", "batch", cause)
        self.data, self.settings, self.seed = data, settings, seed
        self.mirror = posture_mirror(skeleton)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = BodyPartEstimator(data.posture.shape[1], settings.channels)
        self.model.mean.copy_(data.posture.mean(0))
        self.model.std.copy_(data.posture.std(0).clamp(min=settings.least_deviation))
        self.optimiser = torch.optim.AdamW(
            self.model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.steps = 0
        self._order: tuple[int, Tensor] = (-1, torch.empty(0))

    @property
    def total_steps(self) -> int:
        """Steps in all epochs."""
        return max(1, round(self.settings.epochs * (len(self.data) // self.settings.batch)))

    def step(self) -> float:
        """One gradient step; its draws depend on the seed and the step's number alone, so a resumed run is the same."""
        settings = self.settings
        rate = settings.learning_rate * min(1.0, (self.steps + 1) / settings.warm_up)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * 0.5 * (1.0 + math.cos(math.pi * self.steps / self.total_steps))
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.steps)
        self.model.train()
        sample = varied(self.data.rows(self._batch()), self.mirror, settings, generator)
        loss = body_part_loss(self.model, sample, settings.mask_weight, settings.bfloat16)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), settings.gradient_clip)
        if torch.isfinite(norm):  # a step on anything else would spoil every weight
            self.optimiser.step()
        self.steps += 1
        return float(loss.detach())

    def terms(self) -> dict[str, Any]:
        """All that the result depends on but for the pictures themselves."""
        free = ("save_every", "threads")
        settings = {key: value for key, value in asdict(self.settings).items() if key not in free}
        return {**settings, "seed": self.seed, "samples": len(self.data)}

    def state(self) -> State:
        """Everything needed to go on."""
        out = {"steps": torch.tensor(self.steps)}
        out |= {f"model/{key}": value.clone() for key, value in self.model.state_dict().items()}
        for index, parts in self.optimiser.state_dict()["state"].items():
            out |= {f"optimiser/{index}/{key}": torch.as_tensor(value).clone() for key, value in parts.items()}
        return out

    def load(self, state: State) -> None:
        """Go on from :meth:`state` of a training with the same :meth:`terms`."""
        model = {key.removeprefix("model/"): value for key, value in state.items() if key.startswith("model/")}
        self.model.load_state_dict(model)
        moments: dict[int, State] = {}
        for key, value in state.items():
            if key.startswith("optimiser/"):
                _, index, name = key.split("/")
                moments.setdefault(int(index), {})[name] = value.clone()
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        self.steps = int(state["steps"])

    def _batch(self) -> Tensor:
        """Rows of this step: every picture comes once an epoch, but for those that fill no batch."""
        size = self.settings.batch
        epoch, at = divmod(self.steps, len(self.data) // size)
        if self._order[0] != epoch:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
            self._order = epoch, torch.randperm(len(self.data), generator=generator)
        return self._order[1][at * size : (at + 1) * size]


def train_body_part_estimator(
    data: Pictures,
    skeleton: Skeleton,
    settings: BodyPartSettings,
    seed: int,
    folder: Path | None = None,
    told: Callable[[int, int, float], None] | None = None,
) -> BodyPartEstimator:
    """Train a finder; interrupted, it goes on from what it saved.

    Args:
        data: the pictures, without those held out.
        skeleton: of the postures.
        settings: see :class:`BodyPartSettings`.
        seed: of the first weights and of every draw.
        folder: where the state is saved to go on from; None: nowhere.
        told: called after each save with steps, of how many, and the mean loss since the last time.

    Returns:
        The finder, in evaluation mode.

    Raises:
        InputError: there are too few pictures; ``folder`` is damaged or of another training.
    """
    with torch_threads(settings.threads):
        work = BodyPartTraining(data, skeleton, settings, seed)
        if folder is not None and folder.is_dir():
            if read_json(folder, "terms") != work.terms():
                raise InputError(folder, "settings", "are another training's: remove it or name another folder")
            state: State = {}
            RunCheckpoint({"training": ComponentState(dict, state.update)}).restore(folder)
            work.load(state)
            print(f"going on after step {work.steps}, saved in {folder}", file=sys.stderr, flush=True)
        losses: list[float] = []
        while work.steps < work.total_steps:
            losses.append(work.step())
            if work.steps % settings.save_every and work.steps < work.total_steps:
                continue
            if folder is not None:
                parts = {"training": ComponentState(work.state, lambda _: None), "terms": work.terms()}
                metadata = metadata_of("limb finder training", work.model.numbers, 0, work.steps, 0.0)
                RunCheckpoint(parts).save(folder, metadata=metadata)
            if told is not None:
                told(work.steps, work.total_steps, sum(losses) / len(losses))
            losses = []
    return work.model.eval()


@torch.no_grad()
def bodiless_figures(model: BodyPartEstimator, pictures: Tensor, flow: Tensor, batch: int) -> dict[str, float]:
    """What a finder sees where there is no body (:mod:`egopose.vision.bodiless_pictures`).

    Args:
        model: the finder.
        pictures: ``[N, 6, 64, 64]`` uint8. flow: ``[N, 2, 32, 32]``.
        batch: pictures a forward pass.

    Returns:
        ``false``: share of the cells that some mask covers by more than half, and the same by limb; ``variance``: the
        mean of the variances that it states for places of bodies, "up" and the camera's height, in squares of their
        deviations in training. An estimator that knows that it sees nothing states 1 or more.
    """
    model.eval()
    masks, variances = [], []
    for rows in torch.arange(len(pictures)).split(batch):
        mask, _, log_variance = model(pictures[rows, :3], pictures[rows, 3:], flow[rows])
        masks.append(torch.sigmoid(mask) > 0.5)
        variances.append(log_variance[:, : 3 * len(BODIES) + 4].exp())
    covered = torch.cat(masks)
    by_limb = {limb: float(covered[:, at].float().mean()) for at, limb in enumerate(LIMBS)}
    return {"false": float(covered.any(1).float().mean()), **by_limb, "variance": float(torch.cat(variances).mean())}


@torch.no_grad()
def held_out_figures(
    model: BodyPartEstimator, data: Pictures, skeleton: Skeleton, batch: int
) -> dict[str, dict[str, float]]:
    """Share of the variance that is explained (R2), on pictures that were not trained on.

    Returns:
        ``masks``: by limb; ``posture``: by body (mean over x, y, z), ``up`` (likewise) and ``camera height``;
        ``joints``: by joint, a mean over its angles. A number that does not vary counts as not explained.
    """
    model.eval()
    covered, result = [], []
    for rows in torch.arange(len(data)).split(batch):
        part = data.rows(rows)
        masks, posture, _ = model(part.pictures[:, :3], part.pictures[:, 3:], part.flow)
        covered.append(torch.sigmoid(masks))
        result.append(posture * model.std + model.mean)
    by_mask = _explained(torch.cat(covered), data.masks.float() / 255.0, (0, 2, 3))
    by_number = _explained(torch.cat(result), data.posture, (0,)).tolist()
    groups: dict[str, dict[str, list[float]]] = {"posture": {}, "joints": {}}
    here = 3 * len(BODIES) + 4
    for at, (name, value) in enumerate(zip(posture_names(skeleton), by_number, strict=True)):
        group = groups["posture" if at < here else "joints"]
        label = name.rpartition("_" if at >= here else " ")[0] if name != "camera height" else name
        group.setdefault(label, []).append(value)
    out = {"masks": dict(zip(LIMBS, (round(v, 4) for v in by_mask.tolist()), strict=True))}
    return out | {
        key: {name: round(float(np.mean(values)), 4) for name, values in group.items()} for key, group in groups.items()
    }


def _explained(found: Tensor, truth: Tensor, over: Sequence[int]) -> Tensor:
    dims = tuple(over)
    rest = ((found - truth) ** 2).sum(dims)
    spread = ((truth - truth.mean(dims, keepdim=True)) ** 2).sum(dims)
    return torch.where(spread > 0, 1.0 - rest / spread.clamp(min=1e-12), torch.zeros_like(rest))


def save_body_part_estimator(
    folder: str | Path,
    model: BodyPartEstimator,
    skeleton: Skeleton,
    flow: FlowConfig,
    card: Mapping[str, Any],
    steps: int,
) -> Path:
    """Keep a finder as a checkpoint folder: components ``finder``, ``config`` and ``card``.

    ``config`` holds what loading needs: ``numbers``, ``channels``, ``names`` of the numbers, their ``mirror``, and
    ``flow``. ``card`` says what it was trained on and how well it does; no other file may lie in such a folder.

    Raises:
        SaveFailed: the disk is full or cannot be written to.
    """
    mirror = posture_mirror(skeleton)
    config = {
        "numbers": model.numbers,
        "channels": model.mask.in_channels,
        "names": posture_names(skeleton),
        "mirror": {"index": mirror.index.tolist(), "sign": mirror.sign.tolist()},
        "flow": asdict(flow),
    }
    return RunCheckpoint({"finder": model, "config": config, "card": dict(card)}).save(
        folder, metadata=metadata_of("limb finder", model.numbers, 0, steps, 0.0)
    )
