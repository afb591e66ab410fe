"""Boxes in batched worlds, what touches them and what the joints exert, beside plain MuJoCo's own answers."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.humanoid.boxes import DEPTH, with_boxes
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import STATE, BatchedPhysics

SIZES = [(1.2, 1.0), (0.5, 0.6), (0.4, 0.4)]
UPRIGHT = 0.0222 + 0.4767 + 0.4982 + 0.075  # m, of the root with straight legs, soles at height zero


@pytest.fixture(scope="module")
def bare() -> HumanoidModel:
    return default_humanoid()


@pytest.fixture(scope="module")
def humanoid(bare) -> HumanoidModel:
    return with_boxes(bare, SIZES)


def name_of(humanoid: HumanoidModel) -> list[str]:
    return [humanoid.skeleton.names[i] for i in humanoid.touching]


def upright(humanoid: HumanoidModel, places: np.ndarray) -> np.ndarray:
    """qpos of straight bodies whose soles are at ``places [N, 3]``."""
    qpos = np.tile(humanoid.mj_model.qpos0, (len(places), 1))
    qpos[:, :3] = places + np.array([0.0, 0.0, UPRIGHT])
    return qpos


def scattered(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Upper faces and headings of three boxes in each of ``n`` worlds, far enough apart."""
    draw = np.random.default_rng(seed)
    top = np.zeros((n, 3, 3))
    top[..., :2] = draw.uniform(-0.2, 0.2, (n, 3, 2)) + np.array([[0.0, 0.0], [1.6, 0.3], [-1.6, 1.0]])
    top[..., 2] = draw.uniform(0.05, 1.2, (n, 3))
    return top, draw.uniform(-3.0, 3.0, (n, 3))


def on_boxes(humanoid: HumanoidModel, n: int, threads: int = 1, lift: float = 0.05, **kwargs) -> BatchedPhysics:
    """Bodies above the middle of their first box, whose place and height are each world's own."""
    physics = BatchedPhysics(humanoid.mj_model, n, humanoid.substeps, threads, body_ids=humanoid.body_ids, **kwargs)
    top, heading = scattered(n)
    physics.place_boxes(slice(None), top, heading)
    qpos = upright(humanoid, top[:, 0] + np.array([0.0, 0.0, lift]))
    physics.set_state(slice(None), qpos, np.zeros((n, humanoid.mj_model.nv)))
    return physics


def controls(humanoid: HumanoidModel, n: int, steps: int, size: float = 0.3) -> np.ndarray:
    return np.random.default_rng(1).uniform(-size, size, (steps, n, humanoid.mj_model.nu))


def lowest_sole(physics: BatchedPhysics, humanoid: HumanoidModel) -> np.ndarray:
    """``[N]`` m of the lowest heel or ball, by the projected kinematics."""
    state = physics.body_state()
    low = []
    for foot, points in zip(humanoid.feet, humanoid.sole_points, strict=True):
        turn = np.empty((len(state["xquat"]), 9))
        for row, quat in zip(turn, state["xquat"][:, foot], strict=True):
            mujoco.mju_quat2Mat(row, quat)
        low.append((state["xpos"][:, foot, None] + points @ turn.reshape(-1, 3, 3).transpose(0, 2, 1))[..., 2].min(1))
    return np.min(low, axis=0)


def touched(humanoid: HumanoidModel, data: mujoco.MjData) -> np.ndarray:
    """``[E, 1 + K]`` from MuJoCo's own list of contacts."""
    model = humanoid.mj_model
    bodies = humanoid.body_ids[humanoid.touching].tolist()
    out = np.zeros((len(bodies), 1 + model.nmocap), dtype=bool)
    for contact in data.contact[: data.ncon]:
        pair = {int(model.geom_bodyid[g]): int(g) for g in contact.geom}
        for body in set(pair) & set(bodies):
            (other,) = set(pair) - {body}
            out[bodies.index(body), 1 + model.body_mocapid[other] if other else 0] = True
    return out


# --- standing on them ------------------------------------------------------------------------------------------------


def test_a_body_dropped_on_each_worlds_box_comes_to_rest_on_top_and_the_flags_say_so(humanoid) -> None:
    """Five places and heights: soles on the box's face within a centimetre, and nothing but feet touch."""
    physics = on_boxes(humanoid, 5, contacts=True)
    height = physics.body_state()["box_tops"][:, 0, 2]
    assert np.ptp(height) > 0.3
    assert not physics.box_contacts.any()
    for _ in range(15):
        assert not physics.step(np.zeros((5, humanoid.mj_model.nu))).any()
    np.testing.assert_allclose(lowest_sole(physics, humanoid), height, atol=0.01)
    assert np.abs(physics.qvel[:, :3]).max() < 0.1
    feet = [name.endswith("Foot") for name in name_of(humanoid)]
    assert physics.box_contacts[:, feet, 0].all()
    assert not physics.box_contacts[:, np.logical_not(feet)].any()
    assert not physics.box_contacts[..., 1:].any()
    assert not physics.floor_contacts.any()


def test_a_box_is_as_good_as_a_floor(humanoid, bare) -> None:
    """Outside truth: the same drop onto the floor, raised by the box's height, moves alike."""
    ctrl = controls(humanoid, 1, 20, 0.1)
    raised, ground = on_boxes(humanoid, 1), BatchedPhysics(bare.mj_model, 1, bare.substeps, body_ids=bare.body_ids)
    top = raised.body_state()["box_tops"][0, 0]
    ground.set_state([0], upright(bare, np.array([[top[0], top[1], 0.05]])), np.zeros((1, bare.mj_model.nv)))
    for c in ctrl:
        raised.step(c)
        ground.step(c)
    np.testing.assert_allclose(raised.qpos[:, 2] - top[2], ground.qpos[:, 2], atol=2e-3)
    np.testing.assert_allclose(raised.qpos[:, 7:], ground.qpos[:, 7:], atol=0.03)


def test_a_box_taken_away_lets_the_body_fall_and_a_raised_one_lifts_it(humanoid) -> None:
    physics = on_boxes(humanoid, 3, contacts=True)
    still = np.zeros((3, humanoid.mj_model.nu))
    for _ in range(10):
        physics.step(still)
    before = physics.qpos[:, 2].copy()
    state = physics.body_state()
    top, heading = state["box_tops"], scattered(3)[1]
    used = np.ones((3, 3), dtype=bool)
    used[1, 0] = False
    top[2, 0, 2] += 0.02
    physics.place_boxes(slice(None), top, heading, used)
    for _ in range(5):
        physics.step(still)
    moved = physics.qpos[:, 2] - before
    assert abs(moved[0]) < 0.01
    assert moved[1] < -0.08
    assert moved[2] > 0.01
    assert physics.box_contacts[:, :, 0].any(1).tolist() == [True, False, True]


def test_a_body_put_elsewhere_finds_the_boxes_where_they_were(humanoid) -> None:
    physics = on_boxes(humanoid, 3, contacts=True, torques=True)
    physics.step(np.zeros((3, humanoid.mj_model.nu)))
    boxes = physics.box_positions.copy(), physics.box_quaternions.copy()
    physics.set_state(np.array([1]), upright(humanoid, np.zeros((1, 3))), np.zeros((1, humanoid.mj_model.nv)))
    np.testing.assert_array_equal(physics.box_positions, boxes[0])
    np.testing.assert_array_equal(physics.box_quaternions, boxes[1])
    assert not physics.box_contacts[1].any()
    assert (physics.torques.any(1) == [True, False, True]).all()


def test_a_diverged_world_keeps_its_boxes(humanoid) -> None:
    physics = on_boxes(humanoid, 2, contacts=True, torques=True)
    boxes, still = physics.box_positions.copy(), np.zeros((2, humanoid.mj_model.nu))
    physics.step(still)
    physics.qpos[1, 9] = np.nan
    assert physics.step(still).tolist() == [False, True]
    np.testing.assert_array_equal(physics.box_positions, boxes)
    assert np.isfinite(physics.state).all()
    assert not physics.torques[1].any()
    assert physics.torques[0].any()


def test_parked_boxes_touch_nothing_and_leave_the_body_alone(humanoid, bare) -> None:
    """Bodies that fall down among parked boxes move as those of a model without any."""
    physics = BatchedPhysics(humanoid.mj_model, 4, humanoid.substeps, body_ids=humanoid.body_ids, contacts=True)
    ground = BatchedPhysics(bare.mj_model, 4, bare.substeps, body_ids=bare.body_ids)
    for each in (physics, ground):
        qpos = upright(humanoid, np.array([[0.0, 0, 0.01], [0, 0, 0.3], [3, 1, 0], [-2, 0, 0.05]]))
        qpos[:, 3:7] = [np.cos(0.6), 0, np.sin(0.6), 0]  # leaning far ahead
        each.set_state(slice(None), qpos, np.zeros((4, humanoid.mj_model.nv)))
    assert (physics.body_state()["box_tops"][..., 2] < -5).all()
    fell = np.zeros(4, dtype=bool)
    for ctrl in controls(humanoid, 4, 30):
        physics.step(ctrl)
        ground.step(ctrl)
        fell |= physics.floor_contacts.any(1)
        assert not physics.box_contacts.any()
    assert fell.all()
    np.testing.assert_allclose(physics.qpos, ground.qpos, atol=1e-6)


def test_a_worlds_parked_box_is_no_obstacle_to_it_and_is_to_others(humanoid) -> None:
    top, heading = scattered(2)
    physics = on_boxes(humanoid, 2, contacts=True)
    physics.place_boxes([0], top[:1], heading[:1], np.array([[False, True, True]]))
    for _ in range(10):
        physics.step(np.zeros((2, humanoid.mj_model.nu)))
    assert physics.qpos[0, 2] < top[0, 0, 2] + UPRIGHT - 0.05
    assert physics.box_contacts[:, :, 0].any(1).tolist() == [False, True]


# --- flags and torques beside MuJoCo's -------------------------------------------------------------------------------


def test_flags_and_torques_are_those_of_a_loop_over_single_worlds(humanoid) -> None:
    """Contacts: MuJoCo's list after the last substep. Torques: the mean of its ``qfrc_actuator`` over the substeps."""
    n, model = 6, humanoid.mj_model
    physics = on_boxes(humanoid, n, threads=2, lift=0.0, contacts=True, torques=True)
    # Some leaning out over the edge, some on the floor, so that all kinds of contact come about.
    physics.qpos[:3, 0] += np.array([0.4, 0.6, 0.9])
    physics.qpos[4, :3] = [4.0, 4.0, UPRIGHT]
    physics.qpos[5, 3:7] = [np.cos(0.7), np.sin(0.7), 0, 0]
    worlds = [mujoco.MjData(model) for _ in range(n)]
    for data, row in zip(worlds, physics.state, strict=True):
        mujoco.mj_setState(model, data, row, STATE)
    seen = np.zeros((2,), dtype=int)
    for ctrl in controls(humanoid, n, 25, 0.8):
        physics.step(ctrl)
        for i, data in enumerate(worlds):
            data.ctrl[:], data.qacc_warmstart[:] = ctrl[i], 0
            torque = np.zeros(model.nu)
            for _ in range(humanoid.substeps):
                mujoco.mj_step(model, data)
                torque += data.qfrc_actuator[6:]
            np.testing.assert_array_equal(physics.qpos[i], data.qpos)
            np.testing.assert_allclose(physics.torques[i], torque / humanoid.substeps, rtol=0, atol=1e-9)
            expected = touched(humanoid, data)
            np.testing.assert_array_equal(physics.floor_contacts[i], expected[:, 0])
            np.testing.assert_array_equal(physics.box_contacts[i], expected[:, 1:])
            seen += expected[:, 0].sum(), expected[:, 1:].sum()
    assert (seen > 20).all(), seen
    assert (np.abs(physics.torques) <= humanoid.torque_limit + 1e-9).all()
    assert np.abs(physics.torques).max() > 10.0


@pytest.mark.parametrize("told", [{}, {"contacts": True}, {"torques": True}, {"contacts": True, "torques": True}])
def test_who_asks_for_them_moves_the_same(humanoid, told: dict[str, bool]) -> None:
    plain, asked = on_boxes(humanoid, 9), on_boxes(humanoid, 9, threads=2, **told)
    for ctrl in controls(humanoid, 9, 8):
        plain.step(ctrl)
        asked.step(ctrl)
    np.testing.assert_array_equal(plain.state, asked.state)
    for name in ("torques", "floor_contacts", "box_contacts"):
        if not told.get(name.split("_")[-1]):
            with pytest.raises(RuntimeError, match="made without"):
                getattr(asked, name)


def test_sensors_leave_the_bare_body_alone_to_the_bit(bare) -> None:
    sensing = with_boxes(bare, [], touching=["LeftFoot"])
    told = BatchedPhysics(sensing.mj_model, 3, sensing.substeps, contacts=True)
    plain = BatchedPhysics(bare.mj_model, 3, bare.substeps)
    assert told.state.shape == plain.state.shape
    for each in (told, plain):
        each.set_state(slice(None), upright(bare, np.zeros((3, 3))), np.zeros((3, bare.mj_model.nv)))
    for ctrl in controls(bare, 3, 6):
        told.step(ctrl)
        plain.step(ctrl)
    np.testing.assert_array_equal(told.state, plain.state)
    assert told.floor_contacts.shape == (3, 1)
    assert told.box_contacts.shape == (3, 1, 0)
    assert told.floor_contacts.any()


# --- to the bit ------------------------------------------------------------------------------------------------------


def test_threads_and_parts_do_not_matter(humanoid) -> None:
    told = {"contacts": True, "torques": True}
    one, many = on_boxes(humanoid, 21, **told), on_boxes(humanoid, 21, threads=3, **told)
    ranges = (slice(0, 13), slice(13, 21))
    for ctrl in controls(humanoid, 21, 6):
        one.step(ctrl)
        for worlds in ranges:
            many.begin_step(ctrl[worlds], worlds)
        for worlds in ranges:
            many.end_step(worlds)
    for name, values in one.state_dict().items():
        np.testing.assert_array_equal(values, many.state_dict()[name])
    state = many.body_state(ranges[1])
    np.testing.assert_array_equal(state["torques"], one.torques[13:])
    np.testing.assert_array_equal(state["box_contacts"], one.box_contacts[13:])
    np.testing.assert_array_equal(state["floor_contacts"], one.floor_contacts[13:])


def test_a_saved_state_resumes_to_the_bit_with_boxes_and_flags(humanoid) -> None:
    told = {"contacts": True, "torques": True}
    physics, ctrl = on_boxes(humanoid, 4, **told), controls(humanoid, 4, 12)
    for c in ctrl[:6]:
        physics.step(c)
    saved = physics.state_dict()
    assert saved["contacts"].any()
    assert saved["torques"].any()
    other = BatchedPhysics(humanoid.mj_model, 4, humanoid.substeps, body_ids=humanoid.body_ids, **told)
    other.load_state_dict(saved)
    for c in ctrl[6:]:
        for name, values in physics.body_state().items():
            np.testing.assert_array_equal(values, other.body_state()[name], err_msg=name)
        physics.step(c)
        other.step(c)
    for name, values in physics.state_dict().items():
        np.testing.assert_array_equal(values, other.state_dict()[name], err_msg=name)
    # What was saved is a copy.
    assert not np.array_equal(saved["torques"], physics.torques)


def test_a_state_saved_without_boxes_or_flags_still_loads(bare) -> None:
    plain = BatchedPhysics(bare.mj_model, 2, bare.substeps)
    plain.set_state(slice(None), upright(bare, np.zeros((2, 3))), np.zeros((2, bare.mj_model.nv)))
    plain.step(np.zeros((2, bare.mj_model.nu)))
    saved = plain.state_dict()
    assert set(saved) == {"state", "counters"}
    assert saved["state"].shape[1] == mujoco.mj_stateSize(bare.mj_model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    told = BatchedPhysics(bare.mj_model, 2, bare.substeps, torques=True)
    told.step(np.ones((2, bare.mj_model.nu)))
    told.load_state_dict(saved)
    np.testing.assert_array_equal(told.state, plain.state)
    assert not told.torques.any()


# --- placing and building --------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_the_upper_face_is_where_it_was_asked_for(humanoid, seed: int) -> None:
    """By MuJoCo's own kinematics, for any place, height and heading."""
    draw = np.random.default_rng(seed)
    top, heading = draw.uniform(-5, 5, (1, 3, 3)), draw.uniform(-7, 7, (1, 3))
    top[..., 2] = draw.uniform(0, DEPTH, (1, 3))
    physics = BatchedPhysics(humanoid.mj_model, 1, 1)
    physics.place_boxes([0], top, heading)
    np.testing.assert_allclose(physics.body_state()["box_tops"], top, atol=1e-12)
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    mujoco.mj_setState(model, data, physics.state[0], STATE)
    mujoco.mj_kinematics(model, data)
    for k in range(3):
        geom = model.geom(f"box{k}").id
        turn, half = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        assert half[:2] * 2 == pytest.approx(humanoid.box_sizes[k])
        np.testing.assert_allclose(data.geom_xpos[geom] + turn @ [0, 0, half[2]], top[0, k], atol=1e-12)
        np.testing.assert_allclose(turn[:, 0], [np.cos(heading[0, k]), np.sin(heading[0, k]), 0], atol=1e-12)
        assert data.geom_xpos[geom][2] - half[2] <= 1e-12  # it reaches the floor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda top, heading: (top[:, :2], heading[:, :2]), "places of 3 boxes"),
        (lambda top, heading: (top * np.nan, heading), "not finite"),
        (lambda top, heading: (top, heading * np.inf), "not finite"),
        (lambda top, heading: (top - np.array([0, 0, 2.0]), heading), "upper face"),
        (lambda top, heading: (top + np.array([0, 0, DEPTH]), heading), "upper face"),
    ],
)
def test_a_place_where_no_box_can_be_is_refused_and_changes_nothing(humanoid, change, message: str) -> None:
    physics = on_boxes(humanoid, 2)
    before = physics.state.copy()
    with pytest.raises(ValueError, match=message):
        physics.place_boxes(slice(None), *change(*scattered(2)))
    np.testing.assert_array_equal(physics.state, before)


def test_an_unused_boxs_place_is_not_read(humanoid) -> None:
    physics = on_boxes(humanoid, 2)
    top, heading = scattered(2)
    top[:, 1], heading[:, 1] = np.nan, np.nan
    physics.place_boxes(slice(None), top, heading, np.array([[True, False, True]] * 2))
    assert np.isfinite(physics.state).all()
    assert (physics.body_state()["box_tops"][:, 1, 2] < -5).all()


def test_the_body_is_the_same_with_boxes(humanoid, bare) -> None:
    ours, theirs = humanoid.mj_model, bare.mj_model
    assert (ours.nq, ours.nv, ours.nu, ours.nmocap) == (theirs.nq, theirs.nv, theirs.nu, 3)
    np.testing.assert_array_equal(ours.body_mass[humanoid.body_ids], theirs.body_mass[bare.body_ids])
    np.testing.assert_array_equal(ours.geom_size[: theirs.ngeom], theirs.geom_size)
    np.testing.assert_array_equal(ours.dof_armature, theirs.dof_armature)
    floor = ours.geom("floor").id
    for k in range(3):
        box = ours.geom(f"box{k}").id
        for name in ("contype", "conaffinity", "condim", "friction", "solref", "solimp", "margin", "gap", "priority"):
            values = getattr(ours, f"geom_{name}")
            np.testing.assert_array_equal(values[box], values[floor], err_msg=name)
    assert name_of(humanoid) == [bare.skeleton.names[i] for i in bare.end_effectors]
    # The centre of mass is the body's alone, whichever bodies the physics is told of.
    physics, plain = BatchedPhysics(ours, 1, 1), BatchedPhysics(theirs, 1, 1)
    np.testing.assert_array_equal(physics.body_state()["com"], plain.body_state()["com"])


def test_what_cannot_be_built_is_refused(bare, humanoid) -> None:
    for sizes in ([(0.0, 1.0)], [(1.0, -1.0)], [(np.nan, 1.0)]):
        with pytest.raises(ValueError, match="positive sizes"):
            with_boxes(bare, sizes)
    with pytest.raises(ValueError, match="no such bodies: Hoof"):
        with_boxes(bare, SIZES, touching=["Hoof"])
    with pytest.raises(ValueError, match="already has"):
        with_boxes(humanoid, SIZES)
    with pytest.raises(ValueError, match="no contact sensors"):
        BatchedPhysics(bare.mj_model, 1, 1, contacts=True)
