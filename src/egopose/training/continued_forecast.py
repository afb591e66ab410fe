"""Training of the forecaster that goes on frame by frame: acLSTM's network and scheme, as one voice among others."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from egopose.data.spans import Span
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import ContinuedForecaster, spline_times
from egopose.training.fitting import FitResult, fit
from egopose.training.forecaster_settings import ForecasterSettings
from egopose.training.recurrent_baselines import RecurrentLearner, build_forecaster


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
