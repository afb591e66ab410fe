"""Visual context, tracking error and the running normaliser against NumPy, in and out of an environment."""

from __future__ import annotations

import numpy as np
import torch
from helpers.env_stand_in import environment, problem
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.envs.problem import TakeTable
from egopose.envs.transforms import StateNormalizer, TrackingError, VisualContext

ROWS = arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-1e4, 1e4, width=32))


@given(batches=st.lists(ROWS, min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_statistics_are_numpys(batches: list[np.ndarray]) -> None:
    normalizer = StateNormalizer(3)
    for batch in batches:
        normalizer.update(torch.from_numpy(batch))
    rows = np.concatenate(batches)
    assert normalizer.count.item() == len(rows)
    np.testing.assert_allclose(normalizer.mean, rows.mean(0), rtol=1e-9, atol=1e-7)
    expected = rows.std(0, ddof=1) if len(rows) > 1 else np.ones(3)
    np.testing.assert_allclose(normalizer.std, expected, rtol=1e-6, atol=1e-6)


def test_large_nearly_constant_features_stay_finite() -> None:
    """Where E[x^2] - E[x]^2 in float32 is negative."""
    normalizer = StateNormalizer(2)
    generator = torch.Generator().manual_seed(0)
    rows = 1e4 + 1e-3 * torch.randn(5000, 2, generator=generator, dtype=torch.float64)
    rows[:, 1] = 123.456
    for batch in rows.split(50):
        normalizer.update(batch)
    np.testing.assert_allclose(normalizer.std[0], rows[:, 0].std(), rtol=1e-6)
    out = normalizer.normalize(rows.float())
    assert torch.isfinite(out).all()
    assert (out[:, 1].abs() <= 5).all()
    assert normalizer.normalize(rows)[:, 1].abs().max() < 1e-3


def test_values_are_clipped_and_keep_their_dtype() -> None:
    normalizer = StateNormalizer(1, clip=5.0)
    normalizer.update(torch.randn(100, 1))
    out = normalizer.normalize(torch.tensor([[1e6], [-1e6]]))
    assert out.dtype == torch.float32
    assert out.squeeze().tolist() == [5.0, -5.0]


def transformed(n: int = 4, **kwargs) -> tuple[TransformedEnv, StateNormalizer]:
    env = environment(n, **kwargs)
    normalizer = StateNormalizer(env.observation_spec["humanoid_state"].shape[-1])
    table = torch.randn(env.problem.n_frames, 16, generator=torch.Generator().manual_seed(0))
    return TransformedEnv(env, Compose(VisualContext(table), normalizer)), normalizer


def zero_action(env):
    return lambda td: td.set("action", torch.zeros(env.action_spec.shape))


def test_the_transformed_environment_keeps_its_specs() -> None:
    env, _ = transformed()
    check_env_specs(env)
    assert env.observation_spec["visual_context"].shape == (4, 16)


def test_every_new_observation_counts_once() -> None:
    env, normalizer = transformed(problem=problem(termination={"enabled": False, "head_drop": 0.1}))
    raw = []
    base = env.base_env
    original = base.problem.observation

    def spy(state):
        raw.append(original(state))
        return raw[-1]

    base.problem.observation = spy
    td = env.rollout(20, zero_action(env), break_when_any_done=False)
    resets = int(td["next", "done"][:, :-1].sum())
    resets += int(td["next", "done"][:, -1].sum()) * 0  # rollout does not reset after its last step
    assert resets > 0
    assert normalizer.count.item() == 4 + 4 * 20 + resets
    # Whole-batch observations come from the first reset and the steps; the rows in between are the resets'.
    assert torch.isfinite(td["humanoid_state"]).all()
    assert td["humanoid_state"].abs().max() <= 5


def test_worlds_that_go_on_keep_what_the_policy_saw() -> None:
    """A reset of others must not renormalise the observation a world acts on next."""
    env, _ = transformed(problem=problem(termination={"enabled": False, "head_drop": 0.1}))
    td = env.rollout(20, zero_action(env), break_when_any_done=False)
    going = ~td["next", "done"].squeeze(-1)[:, :-1]
    assert (td["next", "humanoid_state"][:, :-1][going] == td["humanoid_state"][:, 1:][going]).all()


def test_context_rows_follow_the_frame() -> None:
    env, _ = transformed()
    table = env.transform[0].table
    td = env.rollout(20, zero_action(env), break_when_any_done=False)
    assert (td["visual_context"] == table[td["frame"].squeeze(-1)]).all()
    assert (td["next", "visual_context"] == table[td["next", "frame"].squeeze(-1)]).all()


def test_context_can_stay_that_of_the_start() -> None:
    env = environment(3)
    table = torch.randn(env.problem.n_frames, 8)
    fixed = TransformedEnv(env, VisualContext(table, frame_key="episode_start"))
    td = fixed.rollout(12, zero_action(fixed), break_when_any_done=False)
    assert (td["visual_context"] == table[td["episode_start"].squeeze(-1)]).all()


def test_frozen_statistics_do_not_move() -> None:
    env, normalizer = transformed()
    env.rollout(5, zero_action(env))
    before = {k: v.clone() for k, v in normalizer.state_dict().items()}
    normalizer.freeze()
    env.rollout(5, zero_action(env))
    assert all((normalizer.state_dict()[k] == v).all() for k, v in before.items())


def test_state_round_trip_to_the_bit() -> None:
    env, normalizer = transformed()
    env.rollout(7, zero_action(env))
    other, restored = transformed()
    other.load_state_dict(env.state_dict())
    for name, value in normalizer.state_dict().items():
        assert (restored.state_dict()[name] == value).all()
        assert restored.state_dict()[name].dtype == value.dtype
    values = torch.randn(5, len(normalizer.mean))
    assert (normalizer.normalize(values) == restored.normalize(values)).all()
    # Outside an environment it normalises and does not count.
    count = restored.count.item()
    restored(TensorDict({"humanoid_state": values}, batch_size=[5]))
    assert restored.count.item() == count


# --- the tracking error --------------------------------------------------------------------------------------------

# Two takes: three frames and one.
STATES = torch.tensor([[1.0, 10.0], [2.0, 10.0], [4.0, 13.0], [9.0, 9.0]])
TAKES = TakeTable(torch.tensor([0, 3]), torch.tensor([3, 1]), torch.zeros(2))
SCALE = torch.tensor([0.5, 2.0])


def error_of(state: list[list[float]], frame: list[int], clip: float = 5.0) -> list[list[float]]:
    td = TensorDict({"humanoid_state": torch.tensor(state), "frame": torch.tensor(frame)[:, None]}, [len(frame)])
    return TrackingError(STATES, TAKES.following(), SCALE, clip)(td)["tracking_error"].tolist()


def test_tracking_error_by_hand() -> None:
    """(state - table[frame]) / scale, then (table[frame + 1] - table[frame]) / scale."""
    assert error_of([[1.5, 8.0], [2.0, 11.0]], [0, 1]) == [[1.0, -1.0, 2.0, 0.0], [0.0, 0.5, 4.0, 1.5]]


def test_after_a_takes_last_frame_the_regressor_stands_still() -> None:
    """It does not go on to the next take's first."""
    assert error_of([[4.0, 14.0], [9.0, 9.0]], [2, 3]) == [[0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]


def test_tracking_error_is_clipped_on_both_sides() -> None:
    assert error_of([[100.0, -100.0]], [1]) == [[5.0, -5.0, 4.0, 1.5]]
    assert error_of([[100.0, -100.0]], [1], clip=3.0) == [[3.0, -3.0, 3.0, 1.5]]


def tracking_env(n: int = 4) -> tuple[TransformedEnv, TrackingError, list[torch.Tensor]]:
    """In the order of training, with a list of the raw states the base environment hands out."""
    env = environment(n, problem=problem(termination={"enabled": False, "head_drop": 0.1}))
    size = env.observation_spec["humanoid_state"].shape[-1]
    generator = torch.Generator().manual_seed(1)
    table = torch.randn(env.problem.n_frames, size, generator=generator)
    tracking = TrackingError(table, env.problem.takes.following(), 0.5 + torch.rand(size, generator=generator), 5.0)
    raw: list[torch.Tensor] = []
    original = env.problem.observation

    def spy(state: TensorDict) -> torch.Tensor:
        raw.append(original(state).float())
        return raw[-1]

    env.problem.observation = spy
    return TransformedEnv(env, Compose(tracking, StateNormalizer(size))), tracking, raw


def numpy_error(tracking: TrackingError, state: torch.Tensor, frame: torch.Tensor) -> np.ndarray:
    table, scale, rows = tracking.table.numpy(), tracking.scale.numpy(), frame.squeeze(-1).numpy()
    now, ahead = table[rows], table[np.where(rows == 39, 39, np.minimum(rows + 1, len(table) - 1))]
    return np.clip(np.concatenate([(state.numpy() - now) / scale, (ahead - now) / scale], axis=-1), -5, 5)


def test_an_environment_with_tracking_error_keeps_its_specs() -> None:
    env, tracking, _ = tracking_env()
    check_env_specs(env)
    assert env.observation_spec["tracking_error"].shape == (4, 2 * tracking.table.shape[-1])


def test_tracking_error_is_that_of_the_raw_state() -> None:
    """The normaliser stands after it, and at the first reset would have made zeros of the state."""
    env, tracking, raw = tracking_env()
    raw.clear()
    td = env.reset()
    np.testing.assert_allclose(td["tracking_error"], numpy_error(tracking, raw[0], td["frame"]), rtol=1e-5, atol=1e-5)
    assert not torch.allclose(td["humanoid_state"], raw[0])
    td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    np.testing.assert_allclose(td["tracking_error"], numpy_error(tracking, raw[1], td["frame"]), rtol=1e-5, atol=1e-5)


def test_reset_worlds_see_their_new_start_and_the_others_what_they_saw() -> None:
    env, tracking, raw = tracking_env()
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    before = td["tracking_error"].clone()
    raw.clear()
    again = env.reset(td.set("_reset", torch.tensor([[True], [False], [True], [False]])))
    expected = numpy_error(tracking, raw[-1], again["frame"])
    fresh = [0, 2]
    np.testing.assert_allclose(again["tracking_error"][fresh], expected[fresh], rtol=1e-5, atol=1e-5)
    assert not torch.equal(again["tracking_error"][fresh], before[fresh])
    assert torch.equal(again["tracking_error"][[1, 3]], before[[1, 3]])


def stepped_both_ways() -> tuple[TransformedEgoPoseEnv, TransformedEgoPoseEnv]:
    size = environment(1).observation_spec["humanoid_state"].shape[-1]
    table = torch.randn(65, size, generator=torch.Generator().manual_seed(1))
    following = problem().takes.following()
    tracking = [TrackingError(table, following, torch.ones(size), 5.0) for _ in range(2)]
    context = [VisualContext(table[:, :16]) for _ in range(2)]
    mine, theirs = (
        TransformedEgoPoseEnv(environment(5, seed=3), tracking[i], context[i], StateNormalizer(size)) for i in range(2)
    )
    return mine, theirs


def test_stepping_and_resetting_at_once_is_torchrls_own_to_the_bit() -> None:
    mine, theirs = stepped_both_ways()
    generator = torch.Generator().manual_seed(0)
    a, b = mine.reset(), theirs.reset()
    resets = 0
    for _ in range(40):
        action = 0.3 * torch.randn(*mine.action_spec.shape, generator=generator)
        before, a = mine.step_and_maybe_reset(a.set("action", action))
        same_before, b = TransformedEnv.step_and_maybe_reset(theirs, b.set("action", action))
        ended = before["next", "done"].squeeze(-1)
        assert (before == same_before.select(*before.keys(True, True))).all()
        assert set(same_before.keys(True, True)) - set(before.keys(True, True)) <= {"action"}
        assert (a == b.select(*a.keys(True, True))).all()
        assert set(b.keys(True, True)) - set(a.keys(True, True)) == {"action"}
        resets += int(ended.sum())
    assert resets > 5
    for name, statistic in mine.state_dict().items():
        torch.testing.assert_close(statistic, theirs.state_dict()[name], rtol=0, atol=0)


def test_a_steps_rows_are_normalised_as_any_others() -> None:
    """What the policy sees in an environment, worked out on arrays, is what it sees outside, to the bit."""
    normalizer = StateNormalizer(5, clip=1.5)
    for rows in torch.randn(4, 7, 5, generator=torch.Generator().manual_seed(3)):
        inside = normalizer._step(TensorDict(), TensorDict(humanoid_state=rows.clone()))["humanoid_state"]
        torch.testing.assert_close(inside, normalizer.normalize(rows), rtol=0, atol=0)
