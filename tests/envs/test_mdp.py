"""The equations against SciPy, hand formulas and their symmetries."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from egopose.core.config import compose_config
from egopose.core.former_names import upgraded
from egopose.envs.mdp import observations as obs
from egopose.envs.mdp import rewards
from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.step_view import StepView
from egopose.envs.mdp.terminations import fallen

UNTURNED = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
WEIGHTS = {"pose": 0.5, "end_effector": 0.3, "root_pose": 0.1, "root_velocity": 0.1}
SCALES = {
    "pose": {"scale": 2.0},
    "end_effector": {"scale": 20.0},
    "root_pose": {"scale": 300.0},
    "root_velocity": {"scale": 1.0, "angular_scale": 0.1},
}
WORLD_WEIGHTS = {"world_pose": 0.65, "joint_velocity": 0.1, "world_end_effector": 0.15, "centre_of_mass": 0.1}
WORLD = {
    "world_pose": {"scale": 2.0},
    "joint_velocity": {"scale": 0.1},
    "world_end_effector": {"scale": 40.0},
    "centre_of_mass": {"scale": 10.0},
}
PATH = {"heading": {"scale": 4.0}, "path": {"scale": 2.0}}


def table(
    weights: dict[str, float], scales: dict[str, dict[str, float]], metric: str = "half_angle", **options: Any
) -> rewards.RewardTable:
    """As a file of ``conf/reward`` describes it."""
    terms = {name: {"weight": weight, **scales[name]} for name, weight in weights.items()}
    return rewards.build_reward({"combine": "mean", "rotation_metric": metric, "terms": terms} | options)


def scipy(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(q.numpy()[..., [1, 2, 3, 0]])


def random_quats(n: int, seed: int = 0) -> torch.Tensor:
    q = torch.randn(n, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return q / q.norm(dim=-1, keepdim=True)


@pytest.fixture(scope="module")
def body() -> tuple[StandIn, TensorDict, obs.BodyLayout]:
    humanoid = stand_in()
    reference, _ = reference_motion(humanoid)
    layout = obs.BodyLayout(torch.as_tensor(humanoid.joint_parent), torch.as_tensor(humanoid.end_effectors))
    return humanoid, reference, layout


def judged(reward: rewards.RewardTable, layout: obs.BodyLayout, state: TensorDict, reference: TensorDict, step):
    return reward(StepView(obs.BodyView(state, layout), obs.BodyView(reference, layout), step))


def moved(state: TensorDict, yaw: float, shift: tuple[float, float]) -> TensorDict:
    """The same bodies, turned about the vertical and carried along the floor."""
    turn = torch.tensor([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], dtype=torch.float64)
    offset = torch.tensor([*shift, 0.0], dtype=torch.float64)
    out = state.clone()
    out["qpos"][:, :3] = rot.rotate(turn, state["qpos"][:, :3]) + offset
    out["qpos"][:, 3:7] = rot.multiply(turn.expand(len(state), 4), state["qpos"][:, 3:7])
    out["qvel"][:, :3] = rot.rotate(turn, state["qvel"][:, :3])
    out["xpos"] = rot.rotate(turn, state["xpos"]) + offset
    out["xquat"] = rot.multiply(turn.expand_as(state["xquat"]), state["xquat"])
    out["com"] = rot.rotate(turn, state["com"]) + offset
    return out


def test_rotations_against_scipy() -> None:
    p, q = random_quats(50), random_quats(50, 1)
    v = torch.randn(50, 3, dtype=torch.float64)
    both = scipy(rot.multiply(p, q))
    assert (both * (scipy(p) * scipy(q)).inv()).magnitude() == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(rot.rotate(q, v).numpy(), scipy(q).apply(v.numpy()), atol=1e-12)
    np.testing.assert_allclose(2 * rot.half_angle_between(q, UNTURNED).numpy(), scipy(q).magnitude(), atol=1e-12)


def test_heading_keeps_only_the_turn_about_the_vertical() -> None:
    q = random_quats(50)
    h = rot.heading(q)
    assert (h[:, 1:3] == 0).all()
    np.testing.assert_allclose(h.norm(dim=-1).numpy(), 1, atol=1e-12)
    np.testing.assert_allclose(h[:, 3] * q[:, 0], h[:, 0] * q[:, 3], atol=1e-12)
    # A half turn about a level axis has none: no division by zero.
    assert torch.isfinite(rot.heading(torch.tensor([[0.0, 1.0, 0.0, 0.0]]))).all()


def test_small_angles_keep_their_digits() -> None:
    tiny = torch.tensor([[1.0, 1e-9, 0.0, 0.0]], dtype=torch.float64)
    assert rewards.rotation_distance(tiny, UNTURNED, "half_angle").item() == pytest.approx(1e-9, rel=1e-6)
    assert rewards.rotation_distance(tiny, UNTURNED, "angle").item() == pytest.approx(2e-9, rel=1e-6)


@given(angle=st.floats(-7.0, 7.0))
def test_rotation_size_is_the_short_way_round(angle: float) -> None:
    q = torch.tensor([[np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]], dtype=torch.float64)
    short = abs((angle + np.pi) % (2 * np.pi) - np.pi)
    for sign in (1, -1):
        assert rewards.rotation_distance(sign * q, UNTURNED, "angle").item() == pytest.approx(short, abs=1e-9)
        assert rewards.rotation_distance(sign * q, UNTURNED, "half_angle").item() == pytest.approx(short / 2, abs=1e-9)


def test_humanoid_state_by_hand(body) -> None:
    _, reference, _ = body
    z = obs.humanoid_state(reference)
    qpos, qvel = reference["qpos"].numpy(), reference["qvel"].numpy()
    root = scipy(reference["qpos"][:, 3:7])
    yaw = 2 * np.arctan2(qpos[:, 6], qpos[:, 3])
    head = Rotation.from_euler("z", yaw[:, None])
    nu = qpos.shape[1] - 7
    assert z.shape == (len(qpos), 2 * qpos.shape[1] - 3)
    np.testing.assert_allclose(z[:, 0], qpos[:, 2])
    assert (scipy(z[:, 1:5]) * (head.inv() * root).inv()).magnitude() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(z[:, 5 : 5 + nu], qpos[:, 7:])
    np.testing.assert_allclose(z[:, 5 + nu : 8 + nu], head.inv().apply(qvel[:, :3]), atol=1e-12)
    np.testing.assert_allclose(z[:, 8 + nu : 11 + nu], qvel[:, 3:6])
    np.testing.assert_allclose(z[:, 11 + nu :], qvel[:, 6:])


def test_joint_rotations_are_the_hinges(body) -> None:
    """Hinges z, y, x in order are SciPy's intrinsic ZYX angles."""
    _, reference, layout = body
    local = obs.BodyView(reference, layout).joint_rotations
    spine = Rotation.from_euler("ZYX", reference["qpos"][:, 7:10].numpy())
    assert (scipy(local[:, 0]) * spine.inv()).magnitude() == pytest.approx(0, abs=1e-9)


def test_each_term_by_hand(body) -> None:
    _, reference, layout = body
    a, b = reference[:20], reference[20:40]
    seen = StepView(obs.BodyView(a, layout), obs.BodyView(b, layout), torch.zeros(len(a)))

    def relative(state: TensorDict, child: int) -> Rotation:
        parent = int(layout.parents[child - 1])
        return scipy(state["xquat"][:, parent]).inv() * scipy(state["xquat"][:, child])

    def heading(state: TensorDict) -> Rotation:
        q = state["qpos"].numpy()
        return Rotation.from_euler("z", 2 * np.arctan2(q[:, 6:7], q[:, 3:4]))

    angles = np.stack([(relative(a, j) * relative(b, j).inv()).magnitude() for j in range(1, a["xquat"].shape[1])], 1)
    for metric, factor in (("half_angle", 0.5), ("angle", 1.0)):
        expected = np.exp(-2 * ((factor * angles) ** 2).sum(1))
        np.testing.assert_allclose(rewards.pose(seen, scale=2.0, metric=metric), expected, rtol=1e-9)

    def ends(state: TensorDict) -> np.ndarray:
        vectors = (state["xpos"][:, layout.end_effectors] - state["qpos"][:, None, :3]).numpy()
        return np.stack([heading(state).inv().apply(vectors[:, e]) for e in range(vectors.shape[1])], 1)

    expected = np.exp(-20 * ((ends(a) - ends(b)) ** 2).sum((1, 2)))
    np.testing.assert_allclose(rewards.end_effector(seen, scale=20.0), expected, rtol=1e-9)

    def tilt(state: TensorDict) -> Rotation:
        return heading(state).inv() * scipy(state["qpos"][:, 3:7])

    height = (a["qpos"][:, 2] - b["qpos"][:, 2]).numpy()
    lean = 0.5 * (tilt(a) * tilt(b).inv()).magnitude()
    expected = np.exp(-300 * (height**2 + lean**2))
    np.testing.assert_allclose(rewards.root_pose(seen, scale=300.0, metric="half_angle"), expected, rtol=1e-9)

    def velocity(state: TensorDict, columns: slice, frame: Rotation) -> np.ndarray:
        return frame.apply(state["qvel"][:, columns].numpy())

    dl = velocity(a, slice(0, 3), heading(a).inv()) - velocity(b, slice(0, 3), heading(b).inv())
    dw = velocity(a, slice(3, 6), tilt(a)) - velocity(b, slice(3, 6), tilt(b))
    expected = np.exp(-(dl**2).sum(1) - 0.1 * (dw**2).sum(1))
    np.testing.assert_allclose(rewards.root_velocity(seen, scale=1.0, angular_scale=0.1), expected, rtol=1e-9)


def test_deepmimic_terms_by_hand(body) -> None:
    _, reference, layout = body
    a, b = reference[:20], reference[20:40]
    seen = StepView(obs.BodyView(a, layout), obs.BodyView(b, layout), torch.zeros(len(a)))
    dv = (a["qvel"] - b["qvel"])[:, 6:].numpy()
    np.testing.assert_allclose(rewards.joint_velocity(seen, scale=0.1), np.exp(-0.1 * (dv**2).sum(1)), rtol=1e-9)
    dc = (a["com"] - b["com"]).numpy()
    np.testing.assert_allclose(rewards.centre_of_mass(seen, scale=10.0), np.exp(-10 * (dc**2).sum(1)), rtol=1e-9)
    de = (a["xpos"] - b["xpos"])[:, layout.end_effectors].numpy()
    expected = np.exp(-40 * (de**2).sum((1, 2)))
    np.testing.assert_allclose(rewards.world_end_effector(seen, scale=40.0), expected, rtol=1e-9)
    root = (scipy(a["qpos"][:, 3:7]) * scipy(b["qpos"][:, 3:7]).inv()).magnitude()
    without_root = rewards.pose(seen, scale=2.0, metric="angle").numpy()
    expected = without_root * np.exp(-2 * root**2)
    np.testing.assert_allclose(rewards.world_pose(seen, scale=2.0, metric="angle"), expected, rtol=1e-9)


@given(yaw=st.floats(-10, 10), x=st.floats(-50, 50), y=st.floats(-50, 50))
@settings(max_examples=30, deadline=None)
def test_heading_turn_and_travel_change_nothing(body, yaw: float, x: float, y: float) -> None:
    _, reference, layout = body
    a, b = reference[:10], reference[10:20]
    reward = table(WEIGHTS, SCALES)
    step = torch.zeros(10, dtype=torch.int64)
    here, there = (judged(reward, layout, state, b, step)[0] for state in (a, moved(a, yaw, (x, y))))
    np.testing.assert_allclose(here, there, rtol=1e-7)
    z = obs.humanoid_state(a)
    np.testing.assert_allclose(z, obs.humanoid_state(moved(a, yaw, (x, y))), atol=1e-9)


@given(st.floats(-9.0, 9.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
@settings(deadline=None, max_examples=30)
def test_heading_and_path_are_of_the_angle_and_the_distance_a_body_was_moved_by(
    body, yaw: float, x: float, y: float
) -> None:
    _, reference, layout = body
    a = reference[:10]
    b, step = moved(a, yaw, (0.0, 0.0)), torch.zeros(10)
    b["qpos"][:, :2] = a["qpos"][:, :2] + torch.tensor([x, y], dtype=torch.float64)
    _, terms = judged(table(dict.fromkeys(PATH, 1.0), PATH), layout, b, a, step)
    short = np.arccos(np.cos(yaw))
    np.testing.assert_allclose(terms["heading"], np.full(10, np.exp(-4.0 * short**2)), atol=1e-6)
    np.testing.assert_allclose(terms["path"], np.full(10, np.exp(-2.0 * (x**2 + y**2))), rtol=1e-9)


def test_parts_of_a_table_add_up_to_the_whole(body) -> None:
    _, reference, layout = body
    a, b, step = reference[:10], reference[10:20], torch.zeros(10)
    for combine in ("mean", "sum"):
        whole = table({**WEIGHTS, "heading": 0.4, "path": 0.2}, {**SCALES, **PATH}, combine=combine, decay_horizon=7)
        own, world = whole.part(WEIGHTS), whole.part(whole.in_world)
        assert (own.names, world.names) == (tuple(WEIGHTS), ("heading", "path"))
        parts = sum(judged(part, layout, a, b, step)[0] for part in (own, world))
        np.testing.assert_allclose(parts, judged(whole, layout, a, b, step)[0], rtol=1e-12)


def test_the_file_with_the_path_weighs_the_papers_terms_as_the_paper_does() -> None:
    paper, ours = (
        rewards.build_reward(compose_config("train", [f"reward={name}"])["reward"])
        for name in ("estimation", "estimation_path")
    )
    assert ours.in_world == ("heading", "path")
    own = ours.part(paper.names)
    assert {name: own.weights[name] for name in paper.names} == pytest.approx(dict(paper.weights))
    assert {name: ours.parameters[name] for name in paper.names} == dict(paper.parameters)


def test_deepmimic_sees_travel(body) -> None:
    _, reference, layout = body
    a = reference[:10]
    reward = table(WORLD_WEIGHTS, WORLD, "angle")
    total, terms = judged(reward, layout, moved(a, 0.0, (0.5, 0.0)), a, torch.zeros(10))
    assert (terms["world_pose"] == 1).all()
    assert (terms["centre_of_mass"] < 0.1).all()
    assert (total < 0.95).all()


@pytest.mark.parametrize(
    "reward",
    [
        table(WEIGHTS, SCALES),
        table(WEIGHTS, SCALES, "angle"),
        table({**WEIGHTS, "root_pose": 0.0, "root_velocity": 0.0}, SCALES),
        table({"pose": 0.5, "end_effector": 0.3}, SCALES),
        table(WORLD_WEIGHTS, WORLD, "angle"),
    ],
)
def test_the_reference_itself_is_worth_one(body, reward: rewards.RewardTable) -> None:
    _, reference, layout = body
    total, terms = judged(reward, layout, reference, reference, torch.zeros(len(reference)))
    np.testing.assert_allclose(total, 1, atol=1e-12)
    assert set(terms) == set(reward.names)
    # q and -q are one rotation.
    flipped = reference.clone()
    flipped["xquat"] = -flipped["xquat"]
    flipped["qpos"][:, 3:7] *= -1
    total, _ = judged(reward, layout, flipped, reference, torch.zeros(len(reference)))
    np.testing.assert_allclose(total, 1, atol=1e-9)
    np.testing.assert_allclose(obs.humanoid_state(flipped), obs.humanoid_state(reference), atol=1e-12)


def test_the_state_of_a_few_rows_is_the_same(body) -> None:
    """As arrays: to the last digits; rows round alike however many there are; and where no heading is left."""
    _, reference, _ = body
    qpos, qvel = reference["qpos"].numpy(), reference["qvel"].numpy()
    rows = obs.humanoid_state_rows(qpos, qvel)
    np.testing.assert_allclose(rows, obs.humanoid_state(reference), rtol=1e-14, atol=1e-15)
    for few in (slice(0, 1), slice(3, 10)):
        np.testing.assert_array_equal(obs.humanoid_state_rows(qpos[few], qvel[few]), rows[few])
    half_turn = qpos[:1].copy()
    half_turn[:, 3:7] = [[0.0, 0.6, 0.8, 0.0]]
    np.testing.assert_allclose(obs.humanoid_state_rows(half_turn, qvel[:1])[0, 1:5], [0.0, 0.6, 0.8, 0.0], atol=1e-15)


def test_total_is_divided_by_the_weights(body) -> None:
    _, reference, layout = body
    a, b, step = reference[:10], reference[10:20], torch.zeros(10)
    double = {k: 2 * w for k, w in WEIGHTS.items()}
    one, terms = judged(table(WEIGHTS, SCALES), layout, a, b, step)
    np.testing.assert_allclose(one, judged(table(double, SCALES), layout, a, b, step)[0])
    np.testing.assert_allclose(one, sum(WEIGHTS[k] * v for k, v in terms.items()), rtol=1e-12)


def test_forecasting_decays_linearly(body) -> None:
    _, reference, layout = body
    step = torch.tensor([0, 45, 90, 120])
    reward = table(WEIGHTS, SCALES, decay_horizon=90)
    total, _ = judged(reward, layout, reference[:4], reference[:4], step)
    np.testing.assert_allclose(total, [1.0, 0.5, 0.0, 0.0], atol=1e-12)


def test_terms_are_added_where_the_table_says_so(body) -> None:
    _, reference, layout = body
    a, b, step = reference[:10], reference[10:20], torch.zeros(10)
    total, terms = judged(table(WEIGHTS, SCALES, combine="sum"), layout, a, b, step)
    np.testing.assert_allclose(total, sum(WEIGHTS[k] * v for k, v in terms.items()), rtol=1e-12)
    more = {**WEIGHTS, "centre_of_mass": 2.0}
    summed, _ = judged(table(more, {**SCALES, **WORLD}, combine="sum"), layout, a, b, step)
    np.testing.assert_allclose(summed - total, 2.0 * rewards.centre_of_mass(view_of(a, b, layout), scale=10.0))


def view_of(a: TensorDict, b: TensorDict, layout: obs.BodyLayout) -> StepView:
    return StepView(obs.BodyView(a, layout), obs.BodyView(b, layout), torch.zeros(len(a)))


def test_a_term_that_is_absent_weighs_nothing(body) -> None:
    _, reference, layout = body
    a, b, step = reference[:10], reference[10:20], torch.zeros(10)
    two = {"pose": 0.5, "end_effector": 0.3}
    without, terms = judged(table(two, SCALES), layout, a, b, step)
    zeros, logged = judged(table({**two, "root_pose": 0.0, "root_velocity": 0.0}, SCALES), layout, a, b, step)
    assert torch.equal(without, zeros)
    assert (set(terms), set(logged)) == (set(two), set(WEIGHTS))


def test_every_term_reads_what_it_says(body) -> None:
    """Of the reference the environment keeps no more than the attributes that terms name."""
    _, reference, layout = body
    body_view, whole = obs.BodyView(reference[:4], layout), obs.BodyView(reference[4:8], layout)
    for name, term in rewards.TERMS.items():
        if term.function.__module__ != rewards.__name__:
            continue
        kept = SimpleNamespace(**{attribute: getattr(whole, attribute) for attribute in term.reads})
        values = {**SCALES, **WORLD, **PATH}[name]
        metric = {"metric": "angle"} if name in ("pose", "root_pose", "world_pose") else {}
        few = term.function(StepView(body_view, kept, torch.zeros(4)), **values, **metric)
        all_of_it = term.function(StepView(body_view, whole, torch.zeros(4)), **values, **metric)
        assert torch.equal(few, all_of_it)


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"terms": {"pose": {"scale": 2.0}}}, r"terms\.pose must be \{weight"),
        ({"terms": {"pose": {"weight": 0.0, "scale": 2.0}}}, "above 0"),
        ({"terms": {"pose": {"weight": -1.0, "scale": 2.0}}}, r"terms\.pose\.weight must be 0 or more"),
        ({"terms": {"pose": {"weight": 1.0}}}, r"terms\.pose\.scale is missing"),
        ({"terms": {"pose": {"weight": 1.0, "scale": 2.0, "angle": 3}}}, r"terms\.pose\.angle is no parameter"),
        ({"terms": {"grace": {"weight": 1.0}}}, r"terms\.grace is no reward term; there are .*pose"),
        ({"combine": "product"}, "combine must be mean or sum"),
    ],
)
def test_bad_reward_settings_are_refused(changed: dict[str, Any], cause: str) -> None:
    good = {"combine": "mean", "rotation_metric": "angle", "terms": {"pose": {"weight": 1.0, "scale": 2.0}}}
    with pytest.raises(ValueError, match=cause):
        rewards.build_reward(good | changed)


def test_a_rotation_has_one_of_two_measures() -> None:
    with pytest.raises(ValueError, match="rotation_metric"):
        rewards.rotation_distance(random_quats(1), UNTURNED, "degrees")


def test_two_terms_cannot_share_a_name() -> None:
    with pytest.raises(ValueError, match="there is a reward term 'pose' already"):

        @rewards.reward_term()
        def pose(view: StepView) -> torch.Tensor:
            return view.step

    with pytest.raises(ValueError, match="contacts, torques, target, scene"):

        @rewards.reward_term(needs=("luck",))
        def lucky(view: StepView) -> torch.Tensor:
            return view.step


@pytest.mark.parametrize("name", ["estimation", "forecasting", "pose_and_end_effectors", "pose_only", "deepmimic"])
def test_a_reward_of_an_old_run_is_todays_table(name: str) -> None:
    """Rewards were a closed set once, under a ``kind``: what such a run directory holds is read as the table it was."""
    today = compose_config("train", [f"reward={name}"])["reward"]
    if name == "deepmimic":
        former = {
            "kind": "world_frame",
            "weights": {"pose": 0.65, "velocity": 0.1, "end_effector": 0.15, "centre_of_mass": 0.1},
            "scales": {"pose": 2.0, "velocity": 0.1, "end_effector": 40.0, "centre_of_mass": 10.0},
            "rotation_metric": "angle",
        }
    else:
        former = {
            "kind": "heading_frame",
            "weights": {term: row["weight"] for term, row in today["terms"].items()},
            "scales": {
                "pose": 2.0,
                "end_effector": 20.0,
                "root_pose": 300.0,
                "root_linear_velocity": 1.0,
                "root_angular_velocity": 0.1,
            },
            "rotation_metric": "half_angle",
            "decay_horizon": 90 if name == "forecasting" else None,
        }
    assert upgraded({"reward": former})["reward"] == today


def test_fall_is_a_head_below_the_take(body) -> None:
    humanoid, reference, _ = body
    state = reference[:2].clone()
    state["xpos"][:, humanoid.head, 2] = torch.tensor([1.41, 1.39], dtype=torch.float64)
    head = state["xpos"][:, humanoid.head, 2]
    assert fallen(head, torch.full((2,), 1.5, dtype=torch.float64), 0.1).tolist() == [False, True]


@pytest.mark.parametrize(
    "reward",
    [table(WEIGHTS, SCALES), table(WORLD_WEIGHTS, WORLD, "angle"), table(dict.fromkeys(PATH, 1.0), PATH)],
)
def test_every_equation_stays_on_the_device_of_its_tensors(body, reward: rewards.RewardTable) -> None:
    """On ``meta`` tensors a constant made on another device, or a value read on the host, raises."""
    _, reference, layout = body
    far = obs.BodyLayout(layout.parents.to("meta"), layout.end_effectors.to("meta"))
    view = obs.BodyView({k: v[:4].to("meta") for k, v in reference.items()}, far)
    total, terms = reward(StepView(view, view, torch.zeros(4, device="meta")))
    z = view.humanoid_state
    low = fallen(view.xpos[:, 6, 2], torch.full((4,), 1.5, device="meta"), 0.1)
    assert {t.device.type for t in (total, *terms.values(), z, low)} == {"meta"}
    assert z.shape == (4, 2 * reference["qpos"].shape[1] - 3)
