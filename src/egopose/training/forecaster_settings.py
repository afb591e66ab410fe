"""The groups of ``conf/forecaster`` as typed settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.training.fitting import FitSettings
from egopose.training.recurrent_baselines import RecurrentSettings


@dataclass(frozen=True)
class ContinuedSettings:
    """The group ``continued`` of ``conf/forecaster``.

    Args:
        share: of its curve at the first frame; the rest is the others'.
        until: frames after which, in a straight line, that is nothing.
        total_frames: of motion it learns from, counted as often as they are seen.
        network: as one of ``conf/baseline``.
        optimiser: its own.
    """

    share: float
    until: int
    total_frames: int
    network: RecurrentSettings
    optimiser: FitSettings

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str) -> ContinuedSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        network = dict(values.get("network") or {})
        optimiser = network.pop("optimiser", None)
        if network.pop("kind", None) != "recurrent" or optimiser is None:
            raise InputError(source, "network", "must be a recurrent one of conf/baseline, its optimiser included")
        parts = {
            "network": RecurrentSettings.from_config(network, f"{source} network"),
            "optimiser": FitSettings.from_config(optimiser),
        }
        return from_mapping(cls, {**values, **parts}, source)

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise InputError("conf/forecaster continued", "share", f"must lie in (0, 1], not {self.share}")
        for name in ("until", "total_frames"):
            if getattr(self, name) < 1:
                cause = f"must be at least 1, not {getattr(self, name)}"
                raise InputError("conf/forecaster continued", name, cause)


@dataclass(frozen=True)
class KernelSettings:
    """The group ``kernel`` of ``conf/forecaster``.

    Args:
        bins: see :class:`KernelForecaster`; they add up to the context.
        axes, whitening, ridge, length: see :func:`egopose.models.kernel_regression.fit_kernel_regression`.
        centres: moments of training remembered at most, evenly chosen; half of them are mirror images.
        share: of its curve; the rest is the networks'.
        added: share of what the likest moments add to the shares of last and mean pose.
        least: frames of the future that a moment must have to be remembered; a take's last pose stands for the rest.
        kept_ridge: of the shares of last and mean pose, in their variance.
    """

    bins: tuple[int, ...]
    axes: int
    whitening: float
    ridge: float
    length: float
    centres: int
    share: float
    added: float
    least: int
    kept_ridge: float

    def __post_init__(self) -> None:
        def check(ok: bool, name: str, cause: str) -> None:
            if not ok:
                raise InputError("conf/forecaster kernel", name, cause)

        check(bool(self.bins) and min(self.bins) > 0, "bins", "must be positive")
        check(self.axes > 0 and self.least > 0, "axes", "must be positive, as must least")
        check(min(self.ridge, self.length, self.kept_ridge) > 0, "ridge", "must be positive, as must the others")
        check(self.centres >= 4, "centres", "must be at least 4")
        check(0 < self.share < 1, "share", "must lie between 0 and 1")
        check(0 < self.added <= 1, "added", "must lie in (0, 1]")


@dataclass(frozen=True)
class ForecasterSettings:
    """The group ``conf/forecaster``, without its ``optimiser``.

    Args:
        recurrent, hidden, dropout: see :class:`MotionForecaster`.
        spacing: frames between the curve's knots.
        context, horizon: frames seen and frames forecast.
        std_floor: of the deviations poses are divided by.
        input_noise: deviations added to each context, one draw a number, and as much again a frame.
        other_weight: of the squared error, in deviations, of what E_pose does not see: height, root velocities, hands.
        cross_fit: forecasters for the training frames, each of which has not seen its own part of them: people where
            people are held out for testing, else blocks of time. 1: forecasters that have seen all, for a policy
            that is not trained.
        members: networks whose curves are averaged.
        total_frames: of motion each network learns from, counted as often as they are seen.
        kernel: of the kernel regression beside the networks, or None for networks alone.
        continued: of the network beside both that goes on frame by frame, or None for none.
        mass_ahead: m, see :func:`egopose.models.grounded_poses.grounded`; None for curves as the networks have them.
    """

    recurrent: int
    hidden: int
    dropout: float
    spacing: int
    context: int
    horizon: int
    std_floor: float
    input_noise: float
    other_weight: float
    cross_fit: int
    members: int
    total_frames: int
    kernel: KernelSettings | None = None
    continued: ContinuedSettings | None = None
    mass_ahead: float | None = None

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/forecaster") -> ForecasterSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        own = {key: value for key, value in values.items() if key not in ("kernel", "continued")}
        settings = from_mapping(cls, own, source)
        if values.get("kernel") is not None:
            kernel = from_mapping(KernelSettings, values["kernel"], f"{source} kernel")
            settings = replace(settings, kernel=kernel)
            if sum(kernel.bins) != settings.context:
                cause = f"must add up to the context's {settings.context} frames, not {sum(kernel.bins)}"
                raise InputError(f"{source} kernel", "bins", cause)
        if values.get("continued") is not None:
            continued = ContinuedSettings.from_config(values["continued"], f"{source} continued")
            settings = replace(settings, continued=continued)
        if settings.context > settings.horizon:  # what is left out about a block is as wide as the horizon
            raise InputError(source, "context", f"must be at most the horizon, {settings.horizon} frames")
        least = {"recurrent": 1, "hidden": 1, "spacing": 1, "context": 1, "horizon": 2, "cross_fit": 1, "members": 1}
        for name, value in least.items():
            if getattr(settings, name) < value:
                raise InputError(source, name, f"must be at least {value}, not {getattr(settings, name)}")
        return settings
