"""Training of a contact network on motion capture that virtual cameras see, and how often it is right."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.motion.rotations import Array
from egopose.scene.contacts import ContactEstimator, ContactNetwork
from egopose.scene.virtual_camera import KINDS
from egopose.scene.window_contacts import WindowNetwork
from egopose.training.contact_clips import ContactClip, ContactSettings, SeenClip, seen_by
from egopose.training.contact_examples import NETWORKS, Examples, joined

_LEAST = 9  # frames: the paper's window
_POINTS = 100  # of the background in training: its cameras are known a little less well than those that judge


@dataclass(frozen=True)
class View:
    """A clip's inputs ``[T, C]`` to a network through one camera, its contacts and which are known, ``[T, 2]`` each."""

    inputs: np.ndarray
    contacts: np.ndarray
    known: np.ndarray


def draw_views(clips: Sequence[ContactClip], settings: ContactSettings) -> tuple[tuple[View, ...], ...]:
    """``settings.views`` times all clips that are long enough, each through a camera of its own.

    The draws do not depend on ``settings.seed``: trainings of several seeds may share them.

    Raises:
        InputError: no clip is long enough.
    """
    clips = [clip for clip in clips if len(clip.points) >= _LEAST]
    if not clips:
        raise InputError("contacts", "takes", f"none has {_LEAST} frames to learn from")
    kinds = list(settings.cameras)
    shares = np.array([settings.cameras[kind] for kind in kinds])
    inputs_of = NETWORKS[settings.network].inputs
    rng = np.random.default_rng(0)
    views = []
    for _ in range(settings.views):
        row = []
        for clip in clips:
            seen = seen_by(clip, str(rng.choice(kinds, p=shares / shares.sum())), settings, rng, _POINTS)
            camera = seen.camera if rng.random() < settings.undone else None
            row.append(View(inputs_of(seen.keypoints, seen.confidence, camera), seen.contacts, ~seen.doubtful))
        views.append(tuple(row))
    return tuple(views)


def train_contact_network(
    views: Sequence[Sequence[View]],
    settings: ContactSettings,
    progress: Callable[[int, float, float], None] | None = None,
) -> ContactNetwork | WindowNetwork:
    """The trained network, in evaluation mode.

    Args:
        views: of :func:`draw_views`, with the same ``settings.network``.
        settings: of all.
        progress: told epoch, mean cross-entropy and seconds after each epoch.
    """
    kind = NETWORKS[settings.network]
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        rng = np.random.default_rng(settings.seed)
        network = kind.make(settings.widths, settings.dropout, settings.input_noise)
        first = _epoch(views[0], settings, rng)
        batch = min(settings.batch, len(first.inputs))
        steps = len(first.inputs) // batch
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, total_steps=max(2, steps * settings.epochs), pct_start=0.15
        )
        network.train()
        for epoch in range(settings.epochs):
            began, total = time.perf_counter(), 0.0
            rows = _epoch(views[epoch % len(views)], settings, rng)
            # The pieces' number varies with their beginnings; steps do not.
            order = torch.arange(steps * batch) % len(rows.inputs)
            for chosen in order.view(steps, batch):
                losses = nn.functional.binary_cross_entropy_with_logits(
                    network(rows.inputs[chosen]), rows.contacts[chosen], reduction="none"
                )
                weights = rows.known[chosen]
                loss = (losses * weights).sum() / weights.sum().clamp(min=1.0)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                total += float(loss.detach())
            if progress is not None:
                progress(epoch + 1, total / steps, time.perf_counter() - began)
    return network.eval()


def _epoch(views: Sequence[View], settings: ContactSettings, rng: np.random.Generator) -> Examples:
    """All clips' examples in a drawn order, half of them mirrored."""
    kind = NETWORKS[settings.network]
    rows = joined([kind.examples(view.inputs, view.contacts, view.known, rng) for view in views])
    flip = torch.from_numpy(rng.random(len(rows.inputs)) < 0.5)
    inputs, contacts, known = rows.inputs.clone(), rows.contacts.clone(), rows.known.clone()
    inputs[flip] = kind.mirrored(inputs[flip])
    contacts[flip], known[flip] = contacts[flip].flip(-1), known[flip].flip(-1)
    order = torch.from_numpy(rng.permutation(len(inputs)))
    return Examples(inputs[order], contacts[order], known[order])


def contact_accuracy(network: ContactEstimator, seen: SeenClip, undone: bool) -> Array:
    """``[T, 2]``: 1 where the network's contact is the label's, 0 elsewhere."""
    estimated = network.probabilities(seen.keypoints, seen.confidence, seen.camera if undone else None) > 0.5
    return (estimated == seen.contacts).astype(np.float64)


def judging_views(
    clips: Sequence[ContactClip], settings: ContactSettings, seed: int, draws: int = 1
) -> dict[str, dict[str, list[SeenClip]]]:
    """``{kind: {clip: views}}``: clips of people that no network has seen, through cameras that none has seen.

    Args:
        clips: the clips.
        settings: the keypoints' errors.
        seed: of the cameras, the same from one kind to the other.
        draws: cameras of each kind for each clip.
    """
    return {
        kind: {
            clip.name: [seen_by(clip, kind, settings, np.random.default_rng([seed, k, place])) for k in range(draws)]
            for place, clip in enumerate(clips)
        }
        for kind in KINDS
    }


def accuracy_table(
    network: ContactEstimator, views: Mapping[str, Mapping[str, Sequence[SeenClip]]]
) -> dict[str, dict[str, dict[str, float]]]:
    """Share of feet and frames in which the network is right.

    Args:
        network: in evaluation mode.
        views: of :func:`judging_views`.

    Returns:
        ``{as seen | undone: {kind: {clip: share}}}``.
    """
    return {
        name: {
            kind: {
                clip: float(np.mean([contact_accuracy(network, one, undone).mean() for one in seen]))
                for clip, seen in rows.items()
            }
            for kind, rows in views.items()
        }
        for name, undone in (("as seen", False), ("undone", True))
    }


def overall(row: dict[str, float], clips: Sequence[ContactClip]) -> float:
    """The clips' mean, weighted by their frames."""
    lengths = {clip.name: len(clip.points) for clip in clips}
    return float(np.average(list(row.values()), weights=[lengths[name] for name in row]))
