"""Training of the forecaster that goes on frame by frame: acLSTM's network and scheme, as one voice among others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.spans import Span
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import ContinuedForecaster, spline_times
from egopose.training.fitting import FitResult, FitSettings, fit
from egopose.training.motion_forecast import ForecasterSettings
from egopose.training.recurrent_baselines import RecurrentLearner, RecurrentSettings, build_forecaster


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


def fit_continued_forecaster(
    poses: Tensor,
    fragments: Sequence[Span],
    mirror: StateMirror,
    settings: ForecasterSettings,
    fps: float,
    seed: int,
) -> tuple[ContinuedForecaster, FitResult]:
    """The network that has learned from the true poses of ``fragments``.

    Args:
        poses: ``[F, P]`` true ones.
        fragments: training stretches, in global frames.
        mirror: of pose states; read where the network's settings ask for mirror images.
        settings: with a continued one's.
        fps: frames per second.
        seed: of its start and its draws.

    Raises:
        InputError: no fragment has two frames.
    """
    own = settings.continued
    assert own is not None
    images = mirror if own.network.mirror else None
    learner = RecurrentLearner(
        poses, fragments, own.network, own.optimiser.batch, own.optimiser.validation_share, seed, images
    )
    result = fit(learner, own.optimiser, seed, own.total_frames)
    return ContinuedForecaster(learner.model, settings.horizon + 1, settings.spacing, fps).eval(), result


def blank_continued_forecaster(
    settings: ForecasterSettings, mean: Tensor, std: Tensor, fps: float
) -> ContinuedForecaster:
    """One that knows nothing yet, for pose states of these statistics ``[P]``."""
    assert settings.continued is not None
    network = build_forecaster(settings.continued.network, mean, std, 0)
    return ContinuedForecaster(network, settings.horizon + 1, settings.spacing, fps)


def continued_share(settings: ForecasterSettings) -> Tensor:
    """Its share of each coefficient ``[K, 1]``."""
    assert settings.continued is not None
    times = spline_times(settings.horizon + 1, settings.spacing)
    return (settings.continued.share * (1.0 - times / settings.continued.until)).clamp(min=0.0)[:, None]
