"""Motion with errors: as large as asked, smooth, in range; and mirror images that are mirror images."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in

from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.starts import Piece
from egopose.motion import rotations as rot
from egopose.tasks.target_variants import TargetError, Variants, mirrored, smooth_noise, target_variants, with_error

NONE = TargetError(joints=0.0, tilt=0.0, heading=0.0, height=0.0, place=0.0, quick=0.07, slow=0.4)
SOME = TargetError(joints=0.1, tilt=0.05, heading=0.1, height=0.02, place=0.08, quick=0.07, slow=0.4)
FRAGMENTS = (Piece(0, 0, 40), Piece(1, 5, 25))
FRAMES = 65
humanoid = cache(stand_in)


@cache
def clips() -> tuple[np.ndarray, ...]:
    reference, takes = reference_motion(humanoid())
    return tuple(part.numpy() for part in reference["qpos"].split(takes.lengths.tolist()))


def variants(errors: tuple[TargetError | None, ...], mirror: bool, seed: int = 0) -> Variants:
    return target_variants(humanoid(), clips(), FRAGMENTS, errors, mirror, seed)  # type: ignore[arg-type]


def test_without_an_error_what_is_followed_is_the_reference() -> None:
    found = variants((None,), mirror=False)
    reference, takes = reference_motion(humanoid())
    for key in ("qpos", "qvel", "xpos", "xquat"):
        torch.testing.assert_close(found.reference[key], reference[key], atol=1e-9, rtol=0)
    torch.testing.assert_close(found.states, humanoid_state(reference).float(), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.joint_targets, reference["qpos"][:, 7:].float())
    path = root_on_floor(reference["qpos"])
    torch.testing.assert_close(found.path, path, atol=1e-9, rtol=0)
    assert found.pieces == found.unmirrored == list(FRAGMENTS)
    assert torch.equal(found.takes.offsets, takes.offsets)
    torch.testing.assert_close(found.takes.lowest_head_height, takes.lowest_head_height)


def test_copies_stand_side_by_side_and_only_what_is_followed_differs() -> None:
    found = variants((None, SOME), mirror=True)
    reference = found.reference["qpos"].reshape(4, FRAMES, -1)
    assert torch.equal(reference[0], reference[1])
    assert torch.equal(reference[2], reference[3])
    targets = found.joint_targets.reshape(4, FRAMES, -1)
    assert torch.equal(targets[0], reference[0, :, 7:].float())
    assert torch.equal(targets[2], reference[2, :, 7:].float())
    away = (targets[1::2] - reference[1::2, :, 7:].float()).abs()
    assert away.mean() > 0.02
    assert found.takes.lengths.tolist() == [40, 25] * 4
    assert found.takes.offsets.tolist() == [0, 40, 65, 105, 130, 170, 195, 235]
    assert found.pieces == [Piece(2 * copy + f.take, f.start, f.stop) for copy in range(4) for f in FRAGMENTS]
    assert found.unmirrored == found.pieces[: 2 * len(FRAGMENTS)]


def test_the_mirror_image_is_what_a_mirror_shows() -> None:
    """Bodies placed by MuJoCo: left and right exchanged and y negated, to rounding."""
    found, body = variants((None,), mirror=True), humanoid()
    names = body.skeleton.names
    swapped = [names.index(name.replace("Left", "*").replace("Right", "Left").replace("*", "Right")) for name in names]
    original, image = (found.reference["xpos"][part] for part in (slice(0, FRAMES), slice(FRAMES, None)))
    expected = original[:, swapped] * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(image, expected, atol=1e-9, rtol=0)
    turned = found.reference["xquat"][:FRAMES, swapped] * torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    same = (turned * found.reference["xquat"][FRAMES:]).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), atol=1e-9, rtol=0)
    path = found.path.reshape(2, FRAMES, 3)
    torch.testing.assert_close(path[1, :, 1:], -path[0, :, 1:], atol=1e-9, rtol=0)


def test_a_mirror_images_image_is_the_motion() -> None:
    qpos = clips()[0]
    np.testing.assert_allclose(mirrored(humanoid(), mirrored(humanoid(), qpos)), qpos, atol=1e-15)  # type: ignore[arg-type]


@pytest.mark.parametrize("deviation", [1.0, 2.1, 12.0])
def test_noise_has_unit_variance_and_is_as_smooth_as_asked(deviation: float) -> None:
    """White noise through a Gaussian filter is correlated as exp(-(lag / 2 sigma)^2) is."""
    noise = smooth_noise(np.random.default_rng(0), 4000, 30, deviation)
    assert noise.shape == (4000, 30)
    assert noise.std() == pytest.approx(1.0, rel=0.06)
    for lag in (1, max(1, round(deviation))):
        found = (noise[lag:] * noise[:-lag]).mean() / noise.var()
        assert found == pytest.approx(np.exp(-((lag / (2 * deviation)) ** 2)), abs=0.05)


@pytest.mark.parametrize("deviation", [0.0, 0.05, 0.2, 0.4, 0.6])
def test_noise_that_is_not_smooth_has_unit_variance_too(deviation: float) -> None:
    assert smooth_noise(np.random.default_rng(0), 2000, 30, deviation).std() == pytest.approx(1.0, rel=0.06)


def still(frames: int = 6000) -> np.ndarray:
    out = np.zeros((frames, humanoid().mj_model.nq))
    out[:, 2], out[:, 3] = 0.9, 1.0
    return out


def wrong(error: TargetError, wide: float = 3.0) -> np.ndarray:
    joint_range = np.tile([-wide, wide], (humanoid().mj_model.nu, 1))
    return with_error(still(), 30.0, joint_range, error, np.random.default_rng(0))


def test_errors_are_as_large_as_asked() -> None:
    """Of a motion that stands: the standard deviation of each part. Joints have shares of .3 to 1.4 of theirs."""
    found = wrong(SOME)
    assert found[:, :2].std() == pytest.approx(SOME.place, rel=0.15)
    assert found[:, 2].std() == pytest.approx(SOME.height, rel=0.15)
    turn = rot.to_rotvec(found[:, 3:7])
    assert turn[:, :2].std() == pytest.approx(SOME.tilt, rel=0.15)
    assert turn[:, 2].std() == pytest.approx(SOME.heading, rel=0.25)
    shares = found[:, 7:].std(0) / SOME.joints
    assert shares.min() > 0.2
    assert shares.max() < 1.6
    assert (shares.max() - shares.min()) > 0.4
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:7], axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("name", ["joints", "tilt", "heading", "height", "place"])
def test_each_error_is_of_its_own_part(name: str) -> None:
    found = wrong(replace(NONE, **{name: 0.1})) - still()
    parts = {
        "place": np.abs(found[:, :2]).max(),
        "height": np.abs(found[:, 2]).max(),
        "tilt": np.abs(found[:, 4:6]).max(),
        "heading": np.abs(found[:, 6]).max(),
        "joints": np.abs(found[:, 7:]).max(),
    }
    assert parts.pop(name) > 0.02
    assert max(parts.values()) < 1e-12


def test_joints_stay_in_their_range() -> None:
    found = wrong(replace(NONE, joints=0.5), wide=0.3)[:, 7:]
    assert np.abs(found).max() == 0.3


def test_a_seed_gives_the_same_errors_and_another_gives_others() -> None:
    first, again, other = (variants((SOME,), mirror=False, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first.states, again.states)
    assert not torch.equal(first.states, other.states)


def test_a_path_has_no_jump_of_a_turn() -> None:
    """A clip that turns beyond half a turn: its path's heading runs on."""
    body: StandIn = humanoid()
    qpos = still(60)
    angle = np.linspace(0.0, 3 * np.pi, 60)
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    found = target_variants(body, [qpos], [Piece(0, 0, 60)], [None], False, 0)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.path[:, 2].diff(), angle[1], atol=1e-9)
