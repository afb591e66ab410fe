"""Looking ahead: the body stays up longer, values are what a plain simulation gives, and nothing else is touched."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import build_problem, environment, group
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in
from helpers.planner_run import SMALL, settings
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.torch_settings import enable_onednn_matmul
from egopose.envs.env import EgoPoseEnv
from egopose.envs.forecasting_transforms import RecurrentStates
from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import Followed, global_frame
from egopose.envs.starts import Piece
from egopose.envs.transforms import StateNormalizer
from egopose.evaluation.agents import estimate_and_judge
from egopose.inference.candidates import Tried
from egopose.inference.estimator import Estimate, estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.gauss_newton_planner import GaussNewtonSettings
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings, planner_settings
from egopose.inference.video import allowed_planner

FRAMES = 60
PIECES = (Piece(0, 0, FRAMES), Piece(1, 0, FRAMES))
humanoid = cache(stand_in)


@cache
def true_motion() -> tuple[TensorDict, Any]:
    return reference_motion(humanoid(), (FRAMES, FRAMES))


def other_motion() -> TensorDict:
    """Each take backwards: body states, but of other frames."""
    reference, _ = true_motion()
    return torch.cat([take.flip(0) for take in reference.split(FRAMES)])


def states_of(reference: TensorDict) -> Tensor:
    return humanoid_state(reference).float()


def make_env(num_envs: int, reference: TensorDict | None = None, threads: int = 1, **action: Any) -> TransformedEnv:
    known, takes = true_motion()
    task = group("task", "estimation")
    task = task | {"termination": {"enabled": False, "head_drop": 0.1}, "action": task["action"] | action}
    body: StandIn = humanoid()
    problem = build_problem(body, known if reference is None else reference, takes, task, group("reward", "estimation"))
    base = environment(num_envs, problem=problem, fragments=PIECES, whole_fragments=True, threads=threads)
    return TransformedEnv(base, Compose(StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])))


def base_of(env: TransformedEnv) -> EgoPoseEnv:
    assert isinstance(env.base_env, EgoPoseEnv)
    return env.base_env


def frozen(env: TransformedEnv) -> TransformedEnv:
    env.transform[0].freeze()
    return env


def actor() -> TensorDictModule:
    """A policy that reacts to the state, a little."""
    size = humanoid().mj_model.nu
    return TensorDictModule(lambda z: 0.05 * torch.sin(z[:, :size]), in_keys=["humanoid_state"], out_keys=["action"])


def passive() -> TensorDictModule:
    size = humanoid().mj_model.nu
    return TensorDictModule(lambda z: torch.zeros(len(z), size), in_keys=["humanoid_state"], out_keys=["action"])


def critic() -> TensorDictModule:
    return TensorDictModule(lambda z: 2.0 + z[:, :1], in_keys=["humanoid_state"], out_keys=["state_value"])


def planner_for(
    num_envs: int,
    states: Tensor,
    policy: TensorDictModule | None = None,
    env: dict[str, Any] | None = None,
    path: Tensor | None = None,
    **changed: Any,
) -> Planner:
    chosen = settings(**{**SMALL, **changed})
    copies = frozen(make_env(num_envs * chosen.samples, **(env or {})))
    return Planner(copies, policy or actor(), critic(), chosen, Followed(states, global_frame, path))


def leaning(env: TransformedEnv, steps: int = 3) -> EgoPoseEnv:
    """Bodies some frames after their start, not where the reference has them."""
    frozen(env).reset()
    base, generator = base_of(env), torch.Generator().manual_seed(1)
    for _ in range(steps):
        action = 0.2 * torch.randn(base.batch_size[0], humanoid().mj_model.nu, generator=generator)
        env.step(TensorDict({"action": action}, base.batch_size))
    return base


def simulated(base: EgoPoseEnv, way: Tensor, followed: TensorDict, chosen: PlannerSettings) -> tuple[Tensor, Tensor]:
    """What ``way [N, H, nu]`` is worth from where ``base`` is, and the score it is chosen by, one step after another.

    The motion that is followed is the reference here, so the environment's own reward and heads are the planner's.
    """
    env = frozen(make_env(base.batch_size[0], followed))
    env.reset()
    here = base_of(env)
    here.load_state_dict(base.state_dict())
    observation, returns, cost = env.transform(here.observe()), 0.0, 0.0
    for step in range(way.shape[1]):
        before = here.body_state()["qvel"]
        observation = actor()(observation)
        observation["action"] = observation["action"] + way[:, step]
        after = env.step(observation)["next"]
        body, frame = here.body_state(), after["frame"].squeeze(-1)
        head = humanoid().head
        low = (followed["xpos"][frame, head, 2] - body["xpos"][:, head, 2]).clamp(min=0)
        change = 30.0 * (body["qvel"] - before).abs().mean(1)
        returns = returns + chosen.discount**step * after["reward"].squeeze(-1)
        cost = cost + chosen.discount**step * (chosen.acceleration * change + chosen.head * low)
        observation = after.exclude("reward", "action")
    returns = returns + chosen.discount ** way.shape[1] * critic()(observation)["state_value"].squeeze(-1)
    env.close()
    return returns, returns - cost


def whole_way(planner: Planner, base: EgoPoseEnv) -> Tensor:
    """The way that was chosen, ``[N, H, nu]``: a planner that plans once in a horizon gives it out step by step."""
    assert planner.settings.every == planner.settings.horizon
    return torch.stack([planner.perturbation(base) for _ in range(planner.settings.horizon)], dim=1)


def run(planner: Planner | None, states: Tensor, policy: TensorDictModule) -> list[Estimate]:
    guard = FailSafe(len(PIECES), FailSafeSettings("off", reset_threshold=0.6, fallen_height=0.3))
    return estimate_takes(make_env(len(PIECES)), policy, critic(), states, guard, planner=planner)


def test_a_body_that_falls_alone_stays_up_longer() -> None:
    states = states_of(true_motion()[0])
    alone = run(None, states, passive())
    planner = planner_for(2, states, passive(), samples=32, horizon=16, every=4, knot_spacing=5)
    ahead = run(planner, states, passive())
    for one, other in zip(alone, ahead, strict=True):
        np.testing.assert_array_equal(one.qpos[0], other.qpos[0])
        assert one.fallen.any()
        upright = np.argmax(other.fallen) if other.fallen.any() else FRAMES
        assert upright > 1.3 * np.argmax(one.fallen)


@pytest.mark.parametrize("rounds", [1, 3])
def test_the_value_is_what_a_plain_simulation_of_the_chosen_way_is_worth(rounds: int) -> None:
    followed = other_motion()
    base = leaning(make_env(2))
    planner = planner_for(2, states_of(followed), rounds=rounds)
    returns, score = simulated(base, whole_way(planner, base), followed, planner.settings)
    torch.testing.assert_close(planner.value, returns.float(), rtol=0, atol=1e-4)
    nothing = torch.zeros(2, planner.settings.horizon, humanoid().mj_model.nu)
    policy_alone = simulated(base, nothing, followed, planner.settings)
    assert (score >= policy_alone[1] - 1e-4).all()
    assert (score > policy_alone[1] + 1e-2).any()  # or there was nothing to choose between


def test_a_body_that_lies_where_it_should_stand_is_worth_nothing() -> None:
    states, env = true_motion()[0], make_env(3)
    base = leaning(env)
    followed = humanoid_state(states).float()
    plain, lost = (planner_for(3, followed, lost=limit) for limit in (9.0, 0.3))
    body = base.body_state()
    qpos = body["qpos"].clone()
    qpos[1, 2] -= 0.35
    base.place(torch.arange(3), qpos, body["qvel"])
    for planner in (plain, lost):
        planner.perturbation(base)
    assert (plain.value != 0).all()
    torch.testing.assert_close(lost.value[[0, 2]], plain.value[[0, 2]])
    assert lost.value[1] == 0
    base.place(torch.arange(3), body["qpos"], body["qvel"])
    lost.perturbation(base)
    assert lost.value[1] != 0, "a body that has got up again is worth its plan"


def test_without_a_better_way_the_policy_goes_on_alone() -> None:
    """Ways that shake are never worth it where acceleration costs a lot."""
    followed = other_motion()
    base = leaning(make_env(2))
    planner = planner_for(2, states_of(followed), acceleration=1e3, deviation=1.0)
    planner._plan[:, ::2] = 2.0  # and the plan so far shakes most
    assert not whole_way(planner, base).any()
    nothing = torch.zeros(2, planner.settings.horizon, humanoid().mj_model.nu)
    returns, _ = simulated(base, nothing, followed, planner.settings)
    torch.testing.assert_close(planner.value, returns.float(), rtol=0, atol=1e-4)


def test_small_gains_change_nothing() -> None:
    """The policy goes on alone while that is within the margin of the best way."""
    followed = other_motion()
    base = leaning(make_env(2))
    free = planner_for(2, states_of(followed), margin=0.0)
    best = whole_way(free, base)
    assert best.abs().amax(dim=(1, 2)).min() > 0
    nothing = torch.zeros_like(best)
    gain = simulated(base, best, followed, free.settings)[1] - simulated(base, nothing, followed, free.settings)[1]
    assert (gain > 0).all()
    wide, narrow = (planner_for(2, states_of(followed), margin=float(m)) for m in (gain.max() + 1, gain.min() / 2))
    assert not whole_way(wide, base).any()
    torch.testing.assert_close(whole_way(narrow, base), best, rtol=0, atol=0)


def test_only_what_balances_is_added_to_and_smoothly() -> None:
    base = leaning(make_env(2))
    planner = planner_for(2, states_of(true_motion()[0]), joints=["Leg"], knot_spacing=4, horizon=9, every=9, rounds=3)
    way = whole_way(planner, base)
    names = [joint.name for joint in humanoid().skeleton.joints for _ in joint.dofs]
    legs = torch.tensor(["Leg" in name for name in names])
    assert way[..., legs].any()
    assert not way[..., ~legs].any()
    bends = way[:, 2:] - 2 * way[:, 1:-1] + way[:, :-2]
    at_knot = torch.tensor([step % 4 == 3 for step in range(bends.shape[1])])
    torch.testing.assert_close(bends[:, ~at_knot], torch.zeros_like(bends[:, ~at_knot]), rtol=0, atol=1e-6)
    assert bends[:, at_knot].abs().max() > 1e-3


def test_planning_touches_nothing_of_the_body_it_is_for() -> None:
    base = leaning(make_env(2))
    planner = planner_for(2, states_of(other_motion()), rounds=2)
    before = {name: value.clone() for name, value in base.state_dict().items()}
    planner.perturbation(base)
    after = base.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_the_same_seed_gives_the_same_estimate_whatever_the_threads() -> None:
    states = states_of(other_motion())
    one, two, other = (
        run(planner_for(2, states, env={"threads": threads}, every=4, seed=seed, rounds=2), states, actor())
        for threads, seed in ((1, 3), (2, 3), (1, 4))
    )
    for a, b, c in zip(one, two, other, strict=True):
        for name in ("qpos", "value", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert not np.array_equal(a.qpos, c.qpos)


def test_the_true_motion_plays_no_part() -> None:
    true, states = true_motion()[0], states_of(other_motion())
    altered = torch.cat([torch.cat([take[:1], take[1:].flip(0)]) for take in true.split(FRAMES)])
    perturbations = []
    for reference in (true, altered):
        base = leaning(make_env(2, reference))
        planner = planner_for(2, states, env={"reference": reference}, rounds=2)
        perturbations.append((whole_way(planner, base), planner.value))
    assert not torch.equal(true["qpos"], altered["qpos"])
    for one, two in zip(*perturbations, strict=True):
        assert torch.equal(one, two)


def test_a_body_that_was_placed_elsewhere_is_planned_for_at_once() -> None:
    followed = other_motion()
    states, base = states_of(followed), leaning(make_env(2))
    planner = planner_for(2, states)
    first = planner.perturbation(base)
    value = planner.value.clone()
    moved = base.body_state()["qpos"]
    moved[:, 9] += 0.4
    base.place(torch.arange(2), moved, torch.zeros(2, humanoid().mj_model.nv, dtype=torch.float64))
    planner.perturbation(base)
    assert torch.equal(planner.value, value)  # the plan goes on
    planner.forget(torch.tensor([0, 1]))
    way = whole_way(planner, base)
    assert not torch.equal(way[:, 0], first)
    returns, _ = simulated(base, way, followed, planner.settings)
    torch.testing.assert_close(planner.value, returns.float(), rtol=0, atol=1e-4)


def test_a_restart_by_the_fail_safe_is_planned_for() -> None:
    """The estimator tells the planner: the frame after a restart has a value of its own, between plans or not."""
    states = states_of(true_motion()[0])
    planner = planner_for(2, states, every=8)
    told: list[list[int]] = []
    forget = planner.forget
    planner.forget = lambda worlds: (told.append(worlds.tolist()), forget(worlds))[1]  # type: ignore[method-assign]
    guard = FailSafe(2, FailSafeSettings("naive", reset_threshold=0.6, fallen_height=1.4))  # higher than any head here
    estimates = estimate_takes(make_env(2), actor(), critic(), states, guard, planner=planner)
    resets = [np.flatnonzero(one.resets) for one in estimates]
    assert len(resets[0])
    assert len(told) == len({int(frame) for rows in resets for frame in rows})
    assert all(
        one.value[frame] != one.value[frame - 1] for one, rows in zip(estimates, resets, strict=True) for frame in rows
    )


# --- rounds ----------------------------------------------------------------------------------------------------------


def tries_of(planner: Planner) -> list[tuple[Tensor, Tensor]]:
    """Ways and their scores, a round at a time, filled while the planner plans."""
    tries: list[tuple[Tensor, Tensor]] = []
    tried = planner._tried

    def spied(now: Any, candidates: Tensor) -> Tried | None:
        made = tried(now, candidates)
        assert made is not None
        tries.append((candidates.clone(), made.score.clone()))
        return made

    planner._tried = spied  # type: ignore[method-assign]
    return tries


def some_plan(planner: Planner, size: float = 0.05) -> Tensor:
    """A plan so far that moves all that may be added to, ``[N, H, nu]``."""
    generator = torch.Generator().manual_seed(5)
    plan = size * torch.randn(planner._plan.shape, generator=generator) * planner._deviation.bool()
    planner._plan.copy_(plan)
    return plan[:, : planner.settings.horizon].clone()


def taken(score: Tensor, candidates: Tensor, chosen: PlannerSettings) -> list[int]:
    """The way for each body by the words of the settings: none, the plan so far, or the one near the best that changes
    least."""
    out = []
    for body, points in enumerate(score.T.tolist()):
        change = [float((way[body] - candidates[1, body]).square().mean()) for way in candidates]
        tie_tolerance = [k for k, point in enumerate(points) if point >= max(points) - chosen.tie_tolerance]
        first = [k for k in (0, 1) if points[k] >= max(points) - chosen.margin]
        out.append(first[0] if first else min(tie_tolerance, key=lambda k: change[k]))
    return out


def test_every_round_is_judged_as_a_plain_simulation_does_and_the_one_near_the_best_is_taken() -> None:
    followed, base = other_motion(), leaning(make_env(2))
    for tie_tolerance in (0.0, 0.15):
        planner = planner_for(2, states_of(followed), samples=5, rounds=3, tie_tolerance=tie_tolerance, margin=0.0)
        some_plan(planner, 0.3)
        tries = tries_of(planner)
        way = whole_way(planner, base)
        assert [len(candidates) for candidates, _ in tries] == [5, 5, 5]
        candidates = torch.cat([candidates for candidates, _ in tries])
        returns, score = (
            torch.stack(values)
            for values in zip(*(simulated(base, one, followed, planner.settings) for one in candidates), strict=True)
        )
        torch.testing.assert_close(torch.cat([one for _, one in tries]), score.float(), rtol=0, atol=1e-4)
        best = taken(score, candidates, planner.settings)
        assert torch.equal(way, candidates[best, [0, 1]])
        torch.testing.assert_close(planner.value, returns[best, [0, 1]].float(), rtol=0, atol=1e-4)
        assert (score[best, [0, 1]] >= score[:5].amax(0) - tie_tolerance - 1e-4).all()
        if tie_tolerance:
            assert (score[best, [0, 1]] < score.amax(0) - 1e-3).any(), "or near changes nothing here"


def test_more_rounds_from_the_same_state_and_seed_find_no_worse_way_and_some_better_ones() -> None:
    followed, base = other_motion(), leaning(make_env(2))
    gains = []
    for seed in range(2):
        found = []
        for rounds in (1, 3):
            planner = planner_for(2, states_of(followed), rounds=rounds, seed=seed, margin=0.0)
            found.append(simulated(base, whole_way(planner, base), followed, planner.settings)[1])
        gains.append(found[1] - found[0])
    assert torch.stack(gains).min() >= -1e-4
    assert (torch.stack(gains) > 1e-2).any(), "or there was nothing better to find"


def test_with_all_ways_near_the_plan_so_far_is_kept_unless_none_is_within_the_margin() -> None:
    followed, base = other_motion(), leaning(make_env(2))
    planner = planner_for(2, states_of(followed), samples=6, rounds=3, tie_tolerance=1e6, margin=0.0)
    plan, tries = some_plan(planner), tries_of(planner)
    kept = whole_way(planner, base)
    assert plan.any()
    score = torch.cat([one for _, one in tries])
    assert (score[0] < score.amax(0)).all()
    assert (score[1] < score.amax(0)).all()
    assert torch.equal(kept, plan)
    wide = planner_for(2, states_of(followed), samples=6, rounds=3, tie_tolerance=1e6, margin=1e5)
    some_plan(wide)
    assert not whole_way(wide, base).any()


@pytest.mark.parametrize(("tie_tolerance", "margin"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.2), (0.1, 0.3), (0.0, 0.2)])
def test_of_any_scores_none_and_the_plan_so_far_come_first_within_the_margin(
    tie_tolerance: float, margin: float
) -> None:
    bodies, base = 40, SimpleNamespace(state_dict=dict)
    planner = planner_for(
        bodies, states_of(true_motion()[0]), samples=4, rounds=3, tie_tolerance=tie_tolerance, margin=margin
    )
    plan, seen, points = some_plan(planner), list[Tensor](), list[Tensor]()

    def scored(now: Any, candidates: Tensor) -> Tried:
        seen.append(candidates.clone())
        points.append(torch.rand(candidates.shape[:2], generator=torch.Generator().manual_seed(len(points))))
        return Tried(candidates, points[-1], 10 + points[-1], 0 * points[-1])

    planner._tried = scored  # type: ignore[method-assign]
    planner._look_ahead(base)  # type: ignore[arg-type]
    candidates, score = torch.cat(seen), torch.cat(points)
    assert torch.equal(candidates[1], plan)
    best, worlds = taken(score, candidates, planner.settings), torch.arange(bodies)
    assert torch.equal(planner._plan[:, : planner.settings.horizon], candidates[best, worlds])
    assert torch.equal(planner._returns, 10 + score[best, worlds])
    # All that can be taken is: the two that come first, and ways of every round.
    assert len({k // 4 for k in best}) == 3
    assert {0, 1} <= set(best)
    assert len(set(best)) > 2


def judged(count: int, bodies: int, plan: Tensor) -> tuple[Tensor, Tensor]:
    """Ways drawn at random, the second the plan so far, and scores of which no body's best are another's."""
    generator = torch.Generator().manual_seed(count)
    candidates = torch.randn(count, *plan.shape, generator=generator)
    candidates[1] = plan
    return candidates, torch.stack([torch.randperm(count, generator=generator).float() for _ in range(bodies)], dim=1)


def between(candidates: Tensor, score: Tensor, body: int) -> list[Tensor]:
    """What a later round tries of a body's ways ``[K, H, nu]`` whatever chance says, by the method's words."""
    order = sorted(range(len(candidates)), key=lambda k: -float(score[k, body]))
    best, plan, nothing = candidates[order[0], body], candidates[1, body], torch.zeros_like(candidates[1, body])
    out = [other + part * (best - other) for part in (0.25, 0.5, 0.75) for other in (plan, nothing)]
    for count in (2, 4, 8):
        mean = candidates[order[:count], body].mean(0)
        out += [mean, 0.5 * mean, (plan + mean) / 2]
    return out


def holds(rows: Tensor, wanted: Tensor) -> bool:
    return bool(((rows - wanted).abs().amax(dim=(1, 2)) < 1e-5).any())


@pytest.mark.parametrize(("samples", "known"), [(20, 20), (20, 60), (15, 15), (9, 9), (3, 3), (3, 9)])
def test_a_later_round_tries_what_lies_between_and_about_the_best(samples: int, known: int) -> None:
    """Fewer samples than ways between: some of these; more: the rest, about the mean of the best four."""
    planner = planner_for(2, states_of(true_motion()[0]), samples=samples)
    candidates, score = judged(known, 2, some_plan(planner))
    start = planner._generator.get_state()
    more = planner._refined(Tried(candidates, score, score, score))
    assert more.shape == (samples, *candidates.shape[1:])
    planner._generator.set_state(start)
    drawn = planner._perturbations(max(samples - 15, 0))
    for body in range(2):
        wanted = between(candidates, score, body)
        if samples >= len(wanted):
            assert all(holds(more[:, body], one) for one in wanted)
        else:
            assert all(holds(torch.stack(wanted), one) for one in more[:, body])
        for row, perturbation in zip(more[15:, body], drawn[:, body], strict=True):
            torch.testing.assert_close(row, wanted[9] + 0.5 * perturbation)
    # A change of one body's scores is a change of its ways alone.
    score[:, 1] = score[:, 1].flip(0)
    planner._generator.set_state(start)
    again = planner._refined(Tried(candidates, score, score, score))
    assert torch.equal(again[:, 0], more[:, 0])
    assert not torch.equal(again[:, 1], more[:, 1])


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"samples": 2}, "samples"),
        ({"rounds": 0}, "rounds"),
        ({"rounds": 1.5}, "rounds"),
        ({"recovery_rounds": -1}, "recovery_rounds"),
        ({"horizon": 1}, "every"),
        ({"every": 0}, "every"),
        ({"knot_spacing": 0}, "knot_spacing"),
        ({"deviation": 0.0}, "deviation"),
        ({"lost": 0.0}, "lost"),
        ({"height_drop": 0.0}, "height_drop"),
        ({"wider": 0.0}, "wider"),
        ({"acceleration": -1.0}, "acceleration"),
        ({"head": -1.0}, "head"),
        ({"margin": -1.0}, "margin"),
        ({"tie_tolerance": -0.1}, "tie_tolerance"),
        ({"place_time": 0.0}, "place_time"),
        ({"heading_time": -1.0}, "heading_time"),
        ({"discount": 0.0}, "discount"),
        ({"discount": 1.1}, "discount"),
        ({"reward": None}, "reward"),
        ({"reward": group("reward", "deepmimic")}, "reward"),
        ({"reward": {**group("reward", "estimation"), "combine": "product"}}, "reward"),
        (
            {"reward": {**group("reward", "estimation_path"), "terms": {"path": {"weight": 1.0, "scale": 1.0}}}},
            "reward",
        ),
        ({"horizon": "far"}, "horizon"),
        ({"speed": 3}, "speed"),
    ],
)
def test_a_bad_setting_is_named(changed: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as refused:
        settings(**changed)
    assert refused.value.field == field


def test_what_cannot_be_planned_for_is_refused() -> None:
    states = states_of(true_motion()[0])
    with pytest.raises(InputError, match="action") as refused:
        planner_for(2, states, env={"kind": "torque"})
    assert "planner=none" in str(refused.value)
    with pytest.raises(InputError, match=r"joints.*Tail"):
        planner_for(2, states, joints=["Tail"])
    env = make_env(12)
    env.append_transform(RecurrentStates({"hidden": 4}))
    with pytest.raises(InputError, match=r"model\.memory"):
        Planner(env, actor(), critic(), settings(**SMALL), Followed(states, global_frame))


def follow(problem: Any, states: Tensor) -> None:
    """Let bodies follow ``states [F, S]`` and their own path."""
    problem.states = states
    problem.motion = problem._motion()


def estimated_by(planner: PlannerSettings | None, made: Callable[[], None] = lambda: None) -> list[Estimate]:
    """What an evaluation makes of both takes; ``made`` is called when it makes an environment."""

    def env_of(split: str, *, num_envs: int, threads: int, fragments: Any, **options: bool) -> TransformedEnv:
        made()
        assert options == {"whole_fragments": True, "falls_end": False}
        assert list(fragments) == list(PIECES)
        env = frozen(make_env(num_envs, threads=threads))
        follow(env.base_env.problem, states)
        return env

    states = states_of(other_motion())
    agent: Any = SimpleNamespace(
        make_env=env_of,
        dataset=SimpleNamespace(test=PIECES),
        actor=actor(),
        critic=critic(),
        followed_states=lambda: states,
        config={"algo": {"gamma": 0.99}},
    )
    failsafe = FailSafeSettings("off", reset_threshold=0.6, fallen_height=0.3)
    return estimate_and_judge(agent, 2, "test", failsafe, 1, None, planner)[0]


def test_an_evaluation_plans_only_where_it_is_told_to() -> None:
    states = states_of(other_motion())
    problem = base_of(make_env(1)).problem
    follow(problem, states)
    path = problem.followed().path
    assert path is not None
    for planned, by_hand in (
        (None, run(None, states, actor())),
        (settings(**SMALL), run(planner_for(2, states, path=path), states, actor())),
    ):
        for one, two in zip(estimated_by(planned), by_hand, strict=True):
            np.testing.assert_array_equal(one.qpos, two.qpos)
            np.testing.assert_array_equal(one.value, two.value)


@pytest.mark.parametrize("before", [1, 2])
def test_an_evaluation_has_the_same_threads_whatever_the_process_did_before(before: int) -> None:
    # Last digits are other ones with other threads or another library of products, and torques that fall tell them.
    found: list[tuple[int, str]] = []
    usual, setting = torch.get_num_threads(), getattr(torch.backends.mkldnn, "matmul")  # noqa: B009
    torch.set_num_threads(before)
    try:
        estimated_by(None, lambda: found.append((torch.get_num_threads(), setting.fp32_precision)))
        assert torch.get_num_threads() == before
    finally:
        torch.set_num_threads(usual)
    assert found == [(1, "bf16" if enable_onednn_matmul() else "none")]


def test_estimates_plan_unless_they_are_causal_or_told_not_to() -> None:
    chosen = compose_config("estimate", ["video=none", "checkpoint=none"])
    assert isinstance(allowed_planner(chosen), GaussNewtonSettings)
    along = compose_config("estimate", ["video=none", "checkpoint=none", "planner=ahead_path"])
    assert allowed_planner(along) == settings(reward=group("reward", "estimation_path"))
    assert allowed_planner({**chosen, "causal": True}) is None
    assert allowed_planner({**chosen, "planner": None}) is None
    with pytest.raises(InputError, match="samples"):  # a wrong setting is told even where it is not used
        allowed_planner({**chosen, "causal": True, "planner": {**chosen["planner"], "samples": 0}})
    for name, words in (("evaluate", []), ("estimate", ["video=none"])):
        without = compose_config(name, ["checkpoint=none", "planner=none", *words])
        assert planner_settings(without.get("planner")) is None


# --- the path --------------------------------------------------------------------------------------------------------


def along(x: float = 0.0, turn: float = 0.0) -> Tensor:
    """A path ``[2 * FRAMES, 3]`` of both takes at ``x`` m/s straight ahead and ``turn`` rad/s."""
    time = torch.arange(FRAMES, dtype=torch.float64).repeat(2) / 30
    return torch.stack([x * time, 0 * time, turn * time], dim=-1)


def path_reward(weight: float) -> dict[str, Any]:
    """The paper's, with heading and path of that weight."""
    table = group("reward", "estimation_path")
    ours = {name: {**table["terms"][name], "weight": weight} for name in ("heading", "path")}
    return {**table, "terms": {**table["terms"], **ours}}


def planner_on(
    path: Tensor | None, reward: dict[str, Any], seed: int = 0, place_time: float = np.inf, **changed: Any
) -> Planner:
    changes = {"samples": 32, "horizon": 12, "every": 6, "deviation": 0.4, "acceleration": 0.0, "margin": 0.0} | changed
    chosen = settings(**{**SMALL, **changes, "place_time": place_time, "reward": reward, "seed": seed})
    copies, states = frozen(make_env(2 * chosen.samples)), states_of(true_motion()[0])
    return Planner(copies, passive(), critic(), chosen, Followed(states, global_frame, path))


def path_terms(turn: Tensor, away: Tensor) -> Tensor:
    """Of bodies that face ``turn [N]`` rad and stand ``away [N, 2]`` m from the path."""
    scales = {name: group("reward", "estimation_path")["terms"][name]["scale"] for name in ("heading", "path")}
    return torch.exp(-scales["heading"] * turn**2) + torch.exp(-scales["path"] * away.square().sum(-1))


def strayed(path: Tensor, weight: float, seed: int) -> tuple[float, float]:
    """How far (rad, m) the bodies' headings and places are from a path in the first 24 frames, in the mean."""
    env, planner = make_env(2), planner_on(path, path_reward(weight), seed)
    frozen(env).reset()
    base, errors = base_of(env), []
    for _ in range(24):
        env.step(TensorDict({"action": planner.perturbation(base)}, base.batch_size))
        assert planner.path is not None
        (place, heading), qpos = planner.path.at(base.frame), base.body_state()["qpos"]
        turn = rot.wrapped(rot.yaw(qpos[:, 3:7]) - heading).abs()
        errors.append(torch.stack([turn, (qpos[:, :2] - place).norm(dim=-1)]))
    env.close()
    turn, way = torch.stack(errors).mean((0, 2)).tolist()
    return turn, way


@pytest.mark.parametrize(("path", "number", "share"), [(along(turn=np.pi / 2), 0, 0.75), (along(x=1.0), 1, 0.96)])
def test_a_body_keeps_closer_to_a_path_that_counts(path: Tensor, number: int, share: float) -> None:
    # A body that stands and sways, and is to turn by 90 degrees a second, or to go a metre a second.
    without, with_it = (np.mean([strayed(path, weight, seed)[number] for seed in (0, 1)]) for weight in (0.0, 20.0))
    assert with_it < share * without


def test_the_path_is_chosen_by_and_no_part_of_the_value() -> None:
    base, candidates = leaning(make_env(2)), None
    found = []
    for weight in (0.0, 2.0):
        planner = planner_on(along(x=1.0, turn=1.0), path_reward(weight))
        candidates = planner._perturbations(planner.settings.samples) if candidates is None else candidates
        assert planner.path is not None
        planner.path.advance(base.frame, base.body_state()["qpos"])
        tried = planner._tried(base.state_dict(), candidates)
        assert tried is not None
        found.append(tried)
    without, with_it = found
    assert torch.equal(without.returns, with_it.returns)
    assert torch.equal(without.low, with_it.low)
    # By hand, of a candidate: what two terms of weight 2 add at most, and what they add to it.
    gained = with_it.score - without.score
    assert (gained > 0).all()
    assert (gained <= 4.0 * sum(0.99**step for step in range(12)) + 1e-4).all()
    here = frozen(make_env(2))
    here.reset()
    body = base_of(here)
    body.load_state_dict(base.state_dict())
    observation, expected = here.transform(body.observe()), torch.zeros(2, dtype=torch.float64)
    begin = base.body_state()["qpos"]
    for step in range(12):
        observation["action"] = candidates[5, :, step]
        observation = here.step(observation)["next"].exclude("reward", "action")
        qpos, passed = body.body_state()["qpos"], (step + 1) / 30
        turn = rot.wrapped(rot.yaw(qpos[:, 3:7]) - rot.yaw(begin[:, 3:7]) - 1.0 * passed)
        # The path is straight in its own world, where the body has turned by what the path's heading is by now.
        facing = rot.yaw(begin[:, 3:7]) - along(turn=1.0)[base.frame, 2]
        way = torch.stack([facing.cos(), facing.sin()], dim=-1) * passed
        expected += 0.99**step * 2.0 * path_terms(turn, qpos[:, :2] - begin[:, :2] - way)
    torch.testing.assert_close(gained[5], expected.float(), rtol=0, atol=1e-4)


def test_a_planned_body_restarts_on_the_planners_path_as_it_lies_by_then() -> None:
    path, states = along(x=2.0, turn=0.5), states_of(true_motion()[0])
    # A body that is put on its path at every frame is planned for at every frame; what the plan is does not matter.
    planner = planner_on(path, path_reward(1.0), place_time=0.5, samples=4, horizon=6)
    guard = FailSafe(2, FailSafeSettings("naive", 0.6, fallen_height=9.0, restart="path"))  # at every frame
    env = make_env(2)
    restart = restart_path("path", env, planner)
    assert restart is planner.path
    estimates = estimate_takes(env, passive(), critic(), states, guard, planner=planner, restart=restart)
    for number, one in enumerate(estimates):
        assert one.resets[1:].all()
        own = path[number * FRAMES : (number + 1) * FRAMES].numpy()
        # Placed on the path at each frame, the body is where the path is: there is nothing to draw the path by.
        facing = rot.yaw(torch.from_numpy(one.qpos[:, 3:7])).numpy()
        np.testing.assert_allclose(np.cos(facing - facing[0] - own[:, 2]), 1.0, atol=1e-9)
        straight = one.qpos[0, :2] + own[:, :1] * np.array([np.cos(facing[0]), np.sin(facing[0])])
        np.testing.assert_allclose(one.qpos[:, :2], straight, atol=1e-9)


def test_what_has_no_path_is_planned_for_as_without_its_terms() -> None:
    base, plans = leaning(make_env(2)), []
    for reward in (group("reward", "estimation"), path_reward(5.0)):
        planner = planner_on(None, reward)
        assert planner.path is None
        plans.append(planner.perturbation(base))
    assert torch.equal(*plans)


# --- rescue ----------------------------------------------------------------------------------------------------------


def sinking_tries(planner: Planner, lows: list[list[float]]) -> list[Tensor]:
    """Ways tried, a round at a time; the best of each round is its last, better than any before, and ends that low."""
    tried: list[Tensor] = []

    def told(now: Any, candidates: Tensor) -> Tried:
        number = len(tried)
        tried.append(candidates.clone())
        score = torch.full(candidates.shape[:2], -100.0)
        score[-1] = float(number)
        low = torch.full(candidates.shape[:2], 5.0)
        low[-1] = torch.tensor(lows[min(number, len(lows) - 1)])
        return Tried(candidates, score, score, low)

    planner._tried = told  # type: ignore[method-assign]
    return tried


@pytest.mark.parametrize(
    ("lows", "rounds"),
    [
        ([[0.1, 0.2]], 2),  # none sinks by more than asked
        ([[9.0, 9.0], [0.0, 0.0]], 2),  # only the best of all counts, after the usual rounds
        ([[0.0, 0.0], [0.0, 0.21]], 5),  # one that sinks is enough, to the end
        ([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [0.1, 0.1]], 4),  # until none does
    ],
)
def test_further_rounds_are_tried_as_long_as_a_body_sinks_in_its_best_way(lows: list[list[float]], rounds: int) -> None:
    changes: dict[str, Any] = {"samples": 20, "rounds": 2, "recovery_rounds": 3, "height_drop": 0.2, "wider": 4.0}
    planner = planner_for(2, states_of(true_motion()[0]), **changes)
    tried = sinking_tries(planner, lows)
    planner._look_ahead(SimpleNamespace(state_dict=dict))  # type: ignore[arg-type]
    assert [len(candidates) for candidates in tried] == [20] * rounds
    best = tried[-1][-1]
    assert torch.equal(planner._plan[:, : planner.settings.horizon], best)


def test_what_is_drawn_to_rescue_is_wider_and_by_turns_anew_and_about_the_best() -> None:
    changes: dict[str, Any] = {"samples": 40, "rounds": 1, "recovery_rounds": 2, "wider": 4.0}
    planner = planner_for(2, states_of(true_motion()[0]), **changes)
    tried = sinking_tries(planner, [[1.0, 1.0]])
    planner._look_ahead(SimpleNamespace(state_dict=dict))  # type: ignore[arg-type]
    usual, anew, about = tried
    spread = [float(candidates[2:].square().mean().sqrt()) for candidates in (usual, anew)]
    assert 3.0 < spread[1] / spread[0] < 5.0
    # The mean of the four best is the same for all that is drawn about it; that is half as wide as what is drawn anew.
    candidates, score = torch.cat([usual, anew]), torch.full((80, 2), -100.0)
    score[39], score[79] = 0.0, 1.0
    fixed = planner._refined(Tried(candidates, score, score, score))[:15]
    torch.testing.assert_close(about[:6], fixed[:6])
    size = float((about[15:] - about[15:].mean(0)).square().mean().sqrt())
    assert 0.35 < size / spread[1] < 0.65


def test_the_head_is_as_low_as_a_plain_simulation_ends() -> None:
    followed, base = true_motion()[0], leaning(make_env(2))
    planner = planner_for(2, states_of(followed))
    candidates = planner._perturbations(planner.settings.samples, 3.0)
    tried = planner._tried(base.state_dict(), candidates)
    assert tried is not None
    low = tried.low
    env = frozen(make_env(2, followed))
    env.reset()
    here = base_of(env)
    here.load_state_dict(base.state_dict())
    observation = env.transform(here.observe())
    for step in range(planner.settings.horizon):
        observation = actor()(observation)
        observation["action"] = observation["action"] + candidates[5, :, step]
        observation = env.step(observation)["next"].exclude("reward", "action")
    head, frame = humanoid().head, observation["frame"].squeeze(-1)
    expected = (followed["xpos"][frame, head, 2] - here.body_state()["xpos"][:, head, 2]).clamp(min=0)
    torch.testing.assert_close(low[5], expected.float(), rtol=0, atol=1e-5)
    assert low.max() > 0.01
    env.close()
