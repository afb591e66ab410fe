"""A blended F from a trained one: the kernel regression on the training frames, and how far each of the two is trusted.

The shares are chosen on cross-fitted predictions, in which no answer comes from a fit that saw its frame. There are few
of them (two for the root, two for the legs, two for the rest of the body): corrections with more numbers did worse on
frames that were not used to choose them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from egopose.checkpoint.body_parts import load_body_part_estimator
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.data.spans import Span, without_block
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.blended import MeanOfKernels, TimeWindows, blended_regressor, kernel_view
from egopose.models.kernel_regression import KernelRegression, fit_kernel_regression
from egopose.models.mirror import StateMirror, state_mirror
from egopose.models.predictions import Flow, take_frames
from egopose.models.regressor import StateRegressor
from egopose.models.regressor_settings import RegressorSettings
from egopose.vision.encoders import FLOW_CHANNELS


@dataclass(frozen=True)
class KernelSettings:
    """``conf/regressor``'s ``kernel``; each file gives every value and its source.

    Args:
        cells: a side of the picture is divided into so many.
        reach, step, width: frames; see :class:`TimeWindows`.
        axes, whitening, ridge, length, metric_rows: see :func:`fit_kernel_regression`.
        centres: moments of training remembered at most, evenly chosen.
        share_step: the shares are multiples of it.
        body_parts: name of the body-part estimator whose answers the kernel sees too; None for flow alone.
        also: further sets of time windows ``(reach, step, width)``, each with a kernel of its own: the kernels' mean
            answers.
        mirror: every moment of training is remembered as its mirror image too.
    """

    cells: int
    reach: int
    step: int
    width: float
    axes: int
    whitening: float
    ridge: float
    length: float
    metric_rows: int
    centres: int
    share_step: float
    body_parts: str | None = None
    also: tuple[tuple[int, int, float], ...] = ()
    mirror: bool = False

    def __post_init__(self) -> None:
        def check(ok: bool, name: str, cause: str) -> None:
            if not ok:
                raise InputError("regressor.kernel", name, cause)

        check(min(self.cells, self.axes, self.metric_rows) > 0, "cells", "must be positive, as must axes, metric_rows")
        for name, sets in (("step", ((self.reach, self.step, self.width),)), ("also", self.also)):
            divides = all(step > 0 and reach >= 0 and reach % step == 0 for reach, step, _ in sets)
            check(divides, name, "the step must divide the reach")
        widths = (self.width, *(width for _, _, width in self.also))
        positive = min(*widths, self.ridge, self.length) > 0
        check(positive, "width", "must be positive, as must ridge, length and the widths of also")
        check(self.centres >= 2, "centres", "must be at least 2")
        check(0 < self.share_step <= 1, "share_step", "must lie in (0, 1]")

    @property
    def limb_numbers(self) -> int:
        """Numbers of a frame that come from the body-part estimator."""
        return 0 if self.body_parts is None else 2 * load_body_part_estimator(self.body_parts).numbers

    def windows(self) -> TimeWindows:
        return TimeWindows(self.reach, self.step, self.width, self.also)

    def input_sizes(self) -> list[int]:
        """Numbers that each kernel sees."""
        return [count * (FLOW_CHANNELS * self.cells**2 + self.limb_numbers) for count in self.windows().counts]


@dataclass(frozen=True)
class Blend:
    """What :func:`blend` makes.

    Attributes:
        model: the blended F.
        kernels: its kernel regressions, one a set of time windows.
        crossed: ``[F, S]`` states z on the training frames from fits that never saw them, blended by the same shares;
            elsewhere without meaning.
        shares: of network and kernel, by part of the body.
    """

    model: StateRegressor
    kernels: list[KernelRegression]
    crossed: Tensor
    shares: dict[str, tuple[float, float]]


@torch.no_grad()
def blend(
    network: StateRegressor,
    crossed_states: Tensor,
    flow: Flow,
    states: Tensor,
    takes: Sequence[Span],
    fragments: Sequence[Span],
    blocks: Sequence[Sequence[Span]],
    humanoid: HumanoidModel,
    settings: RegressorSettings,
    kernel_settings: KernelSettings,
) -> Blend:
    """A blended F.

    Args:
        network: trained on all ``fragments``; its parts become those of the answer.
        crossed_states: ``[F, S]`` states z, on the training frames by networks that never saw them.
        flow: of the whole store.
        states: ``[F, S]`` the true ones.
        takes: each a clip by itself.
        fragments: training frames.
        blocks: which of them are left out together, as ``crossed_states`` were.
        humanoid: whose states they are.
        settings: of F.
        kernel_settings: of the kernel and the shares.
    """
    with torch_threads(settings.threads):
        views = view_table(flow, takes, kernel_settings, settings.encode_batch)
        seen = windowed(views, takes, kernel_settings)
        image = mirror_image(views, takes, states, network, humanoid, kernel_settings)
        wanted, by_network = network.normalise(states), network.normalise(crossed_states)
        by_kernel = torch.zeros_like(wanted)
        importance = importance_of(humanoid, network.state_std)
        for block in blocks:
            others = without_block(fragments, block, settings.margin, settings.margin)
            left_out = MeanOfKernels(fit_kernels(seen, wanted, others, kernel_settings, importance, image))
            for span in block:
                by_kernel[span.start : span.stop] = left_out(seen[span.start : span.stop])
        kernels = fit_kernels(seen, wanted, fragments, kernel_settings, importance, image)
    model = blended_regressor(
        network, kernels, kernel_settings.cells, kernel_settings.windows(), kernel_settings.limb_numbers
    )
    frames = torch.cat([torch.arange(s.start, s.stop) for s in fragments])
    starts = torch.tensor([span.start for span in takes])
    take = torch.searchsorted(starts, frames, right=True) - 1
    chosen = {}
    for part, (members, judged, unit) in share_groups(humanoid, model.state_std).items():
        first, second, truth = ((rows[frames][:, judged] * unit) for rows in (by_network, by_kernel, wanted))
        chosen[part] = choose_shares(first, second, truth, take, kernel_settings.share_step)
        model.head.network_share[members], model.head.kernel_share[members] = chosen[part]
    crossed = model.head.network_share * by_network + model.head.kernel_share * by_kernel
    return Blend(model, kernels, crossed * model.state_std + model.state_mean, chosen)


def mirror_image(
    views: Tensor,
    takes: Sequence[Span],
    states: Tensor,
    model: StateRegressor,
    humanoid: HumanoidModel,
    settings: KernelSettings,
) -> tuple[Tensor, Tensor] | None:
    """What the kernels see of the mirrored scene and its states in normalised units; None where it is not learned."""
    if not settings.mirror:
        return None
    table = windowed(mirrored_view(views, settings), takes, settings)
    return table, model.normalise(state_mirror(humanoid.skeleton).state(states))


@torch.no_grad()
def window_table(
    flow: Flow, takes: Sequence[Span], settings: KernelSettings, batch: int, mirrored: bool = False
) -> Tensor:
    """What the kernels see of each frame, ``[F, V]`` float32; zero outside of ``takes``.

    Args:
        flow: ``[F, 2, S, S]`` of the whole store, with a third plane where the kernel sees limbs.
        takes: each a clip by itself.
        settings: of the cells and windows.
        batch: frames read at a time.
        mirrored: of the scene's mirror image.
    """
    views = view_table(flow, takes, settings, batch)
    return windowed(mirrored_view(views, settings) if mirrored else views, takes, settings)


def windowed(views: Tensor, takes: Sequence[Span], settings: KernelSettings) -> Tensor:
    """The time windows of frames seen each by itself (:func:`view_table`), take by take, ``[F, V]``."""
    windows = settings.windows()
    rows = torch.zeros(len(views), windows.count * views.shape[1])
    for span in takes:
        rows[span.start : span.stop] = windows(windows.pad(views[None, span.start : span.stop]))[0]
    return rows


@torch.no_grad()
def view_table(flow: Flow, takes: Sequence[Span], settings: KernelSettings, batch: int) -> Tensor:
    """As :func:`window_table`, each frame by itself: ``[F, 2 cells^2 + limbs]``."""
    rows = torch.zeros(len(flow), FLOW_CHANNELS * settings.cells**2 + settings.limb_numbers)
    for span in takes:
        for at in range(span.start, span.stop, batch):
            part = np.arange(at, min(at + batch, span.stop))
            rows[part] = kernel_view(take_frames(flow, part), settings.cells, settings.limb_numbers)
    return rows


def mirrored_view(view: Tensor, settings: KernelSettings) -> Tensor:
    """Mirror image of what the kernels see of each frame, ``[T, V]`` (:func:`egopose.models.blended.kernel_view`)."""
    flow, limbs = view.split([FLOW_CHANNELS * settings.cells**2, settings.limb_numbers], dim=1)
    parts = [StateMirror.flow(flow.unflatten(1, (FLOW_CHANNELS, settings.cells, settings.cells))).flatten(1)]
    if settings.body_parts is not None:
        parts.append(load_body_part_estimator(settings.body_parts).mirrored_rows(limbs))
    return torch.cat(parts, dim=1)


def fit_kernels(
    table: Tensor,
    wanted: Tensor,
    spans: Sequence[Span],
    settings: KernelSettings,
    importance: Tensor,
    image: tuple[Tensor, Tensor] | None,
) -> list[KernelRegression]:
    """The kernel regressions learned on ``spans``, one a set of time windows.

    Args:
        table: ``[F, V]`` of :func:`window_table`.
        wanted: ``[F, S]`` states in normalised units.
        spans: training frames.
        settings: of the kernel.
        importance: ``[S]`` of the state's numbers for what counts as alike.
        image: ``table`` and ``wanted`` of the mirrored scene, where it is learned as well; the centres are shared.
    """
    frames = torch.cat([torch.arange(s.start, s.stop) for s in spans])
    both = [(table, wanted)] if image is None else [(table, wanted), image]
    centres = settings.centres // len(both)
    if len(frames) > centres:
        frames = frames[torch.linspace(0, len(frames) - 1, centres).round().long()]
    outputs = torch.cat([states[frames] for _, states in both])
    kernels, first = [], 0
    for size in settings.input_sizes():
        inputs = torch.cat([seen[frames, first : first + size] for seen, _ in both])
        first += size
        kernels.append(
            fit_kernel_regression(
                inputs,
                outputs,
                axes=settings.axes,
                whitening=settings.whitening,
                ridge=settings.ridge,
                length=settings.length,
                importance=importance,
                metric_rows=settings.metric_rows,
            )
        )
    return kernels


def importance_of(humanoid: HumanoidModel, state_std: Tensor) -> Tensor:
    """``[S]``: the joint angles in rad without the hands, as E_pose has them; nothing else of the state."""
    out = torch.zeros_like(state_std)
    angles = StateLayout.of_size(len(state_std)).joint_angles
    out[angles] = state_std[angles]
    out[angles][torch.as_tensor(humanoid.hand_dofs)] = 0.0
    return out


def share_groups(humanoid: HumanoidModel, state_std: Tensor) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Root, legs and the rest of the body: columns of z that share, columns that are judged, and the latter's units.

    Angles are judged in rad, hands left out, as E_pose has it; the root's eleven numbers in normalised units. A joint's
    velocity goes with its angle.

    Args:
        humanoid: whose state z is.
        state_std: ``[S]``.
    """
    skeleton = humanoid.skeleton
    below: set[int] = set()
    for foot in humanoid.feet.tolist():
        while foot > 0:
            below.add(foot)
            foot = int(skeleton.parents[foot])
    owner = [index for index, joint in enumerate(skeleton.joints) for _ in joint.dofs]
    leg = torch.tensor([index in below for index in owner])
    dofs, hands = torch.arange(len(owner)), set(humanoid.hand_dofs.tolist())
    layout = StateLayout(len(owner))
    column = torch.arange(layout.size)
    angles, velocities = column[layout.joint_angles], column[layout.joint_velocities]
    root = torch.cat([column[layout.root_pose], column[layout.root_velocity]])
    groups = {"root": (root, root, torch.ones(len(root)))}
    for part, members in (("legs", dofs[leg]), ("upper_body", dofs[~leg])):
        judged = angles[[d for d in members.tolist() if d not in hands]]
        groups[part] = (torch.cat([angles[members], velocities[members]]), judged, state_std[judged])
    return groups


def choose_shares(network: Tensor, kernel: Tensor, wanted: Tensor, take: Tensor, step: float) -> tuple[float, float]:
    """Shares of network and kernel whose mean distance to the truth is least; they are at most 1 together.

    Args:
        network: ``[N, J]`` cross-fitted predictions less the training mean.
        kernel: ``[N, J]`` likewise.
        wanted: ``[N, J]`` the truth less the training mean.
        take: ``[N]`` int64; each take counts alike, as in the metrics.
        step: of the grid.
    """
    weight = 1.0 / torch.bincount(take)[take].double()
    levels = round(1 / step)
    best, chosen = float("inf"), (0.0, 0.0)
    for first in range(levels + 1):
        for second in range(levels + 1 - first):
            a, b = first / levels, second / levels
            error = float(((a * network + b * kernel - wanted).norm(dim=1).double() * weight).sum())
            if error < best:
                best, chosen = error, (a, b)
    return chosen
