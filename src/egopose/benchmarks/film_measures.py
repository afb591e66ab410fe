"""What an estimate of a walk from film is judged by: speed, turns, path, steps and pose, beside the true motion."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import welch

from egopose.evaluation.metrics import pose_error
from egopose.evaluation.path_metrics import (
    forward_speed_ratio,
    heading_error,
    net_path_error_percent,
    path_of,
    yaw_rate_correlation,
)
from egopose.humanoid.model import HumanoidModel
from egopose.motion.rotations import Array

#: Of a film, in the order of tables, with their heads there and decimals.
MEASURES = {
    "speed": ("speed / true", 2),
    "yaw_r": ("yaw rate r", 2),
    "yaw_r_raw": ("r within steps", 2),
    "net_path_percent": ("net path error, %", 1),
    "heading_degrees": ("heading error, deg", 1),
    "step_error": ("steps/s error", 2),
    "e_pose": ("E_pose, rad", 2),
    "drift": ("mean speed, m/s", 3),
    "turn_per_minute": ("turn, deg/min", 0),
}
#: Of a film: the measures of walks, and of people who stand or turn where they are.
OF_WALKS = ("speed", "yaw_r", "yaw_r_raw", "net_path_percent", "heading_degrees", "step_error", "e_pose")
OF_STANDING = ("drift", "turn_per_minute", "e_pose")
OF_TURNING = ("drift", "yaw_r", "yaw_r_raw", "heading_degrees", "step_error", "e_pose")
#: s, standard deviation of the Gaussian over yaw rates: within a step the hips swing, which is no turn.
_SMOOTH = 0.25
#: Hz of strides, and of a spectrum's points.
_STRIDES, _POINT = (0.4, 2.0), 0.01
#: rad, root mean square: legs that swing less do not step.
_SMALLEST_SWING = 0.03
_THIGHS = ("RightUpLeg_0", "LeftUpLeg_0")


def measures(humanoid: HumanoidModel, estimate: Array, truth: Array) -> dict[str, float]:
    """All of :data:`MEASURES` of an estimate ``[T, nq]`` beside the truth ``[T, nq]``; NaN where one has no meaning.

    ``speed`` is the estimate's forward speed over the truth's. ``yaw_r`` is Pearson's r of yaw rates smoothed by
    0.25 s, ``yaw_r_raw`` of yaw rates as they are. ``step_error`` is in steps a second. ``drift`` is the estimate's
    mean speed (m/s) and ``turn_per_minute`` its net turn (degrees a minute) beyond the truth's.
    """
    fps = 1.0 / humanoid.control_dt
    path, heading = path_of(estimate)
    true_path, true_heading = path_of(truth)
    one, other = (gaussian_filter1d(angle, _SMOOTH * fps, mode="nearest") for angle in (heading, true_heading))
    seconds = max(len(truth) - 1, 1) / fps
    excess = (heading[-1] - heading[0]) - (true_heading[-1] - true_heading[0])
    steps = step_frequency_of_legs(humanoid, estimate), step_frequency_of_legs(humanoid, truth)
    return {
        "speed": forward_speed_ratio(path, heading, true_path, true_heading, fps),
        "yaw_r": yaw_rate_correlation(one, other, fps),
        "yaw_r_raw": yaw_rate_correlation(heading, true_heading, fps),
        "net_path_percent": net_path_error_percent(path, heading, true_path, true_heading),
        "heading_degrees": float(np.rad2deg(heading_error(heading, true_heading, fps))),
        "step_error": abs(steps[0] - steps[1]),
        "e_pose": float(pose_error(estimate, truth, humanoid.hand_dofs.tolist()).mean()),
        "drift": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / seconds),
        "turn_per_minute": float(np.rad2deg(abs(excess)) * 60.0 / seconds),
    }


def step_frequency_of_legs(humanoid: HumanoidModel, qpos: Array) -> float:
    """Steps a second of ``qpos [T, nq]``: twice the rate at which the thighs swing against each other; NaN where they
    do not.

    A looped walk hardly bobs, so the bob of the root tells less.
    """
    fps = 1.0 / humanoid.control_dt
    right, left = (int(humanoid.mj_model.joint(name).qposadr[0]) for name in _THIGHS)
    swing = qpos[:, right] - qpos[:, left]
    if len(swing) < 2 or swing.std() < _SMALLEST_SWING:
        return float("nan")
    segment = min(len(swing), round(5.0 * fps))
    frequency, power = welch(swing - swing.mean(), fps, nperseg=segment, nfft=round(fps / _POINT))
    inside = (frequency >= _STRIDES[0]) & (frequency <= _STRIDES[1])
    return 2.0 * float(frequency[inside][np.argmax(power[inside])])


def share_in_order(good: Array, bad: Array) -> float:
    """Area under the ROC curve: how often a good score is above a bad one, ties counting half. NaN without either."""
    if not len(good) or not len(bad):
        return float("nan")
    ordered = np.sort(bad)
    below = np.searchsorted(ordered, good, "left") + np.searchsorted(ordered, good, "right")
    return float(below.mean() / (2.0 * len(bad)))


def area_interval(good: list[Array], bad: list[Array], draws: int = 500, seed: int = 0) -> tuple[float, float, float]:
    """Area and its 95% interval of scores by film; films are drawn with repetition, all frames of a film together."""
    if not good or not bad:
        return (float("nan"),) * 3
    rng = np.random.default_rng(seed)
    area = share_in_order(np.concatenate(good), np.concatenate(bad))
    drawn = [
        share_in_order(*(np.concatenate([films[i] for i in rng.integers(0, len(films), len(films))]) for films in both))
        for both in [(good, bad)] * draws
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return area, float(low), float(high)
