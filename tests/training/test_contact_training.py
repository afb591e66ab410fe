"""Training the contact network: what the clips say, that it learns, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.mocap import default_humanoid, hold_out_the_turn
from helpers.walking import walking

from egopose.checkpoint.contacts import load_contact_network
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.pipeline.contacts import train_contacts
from egopose.training.contact_clips import ContactClip, ContactSettings, another_body, contact_clip, seen_by
from egopose.training.contact_examples import PIECE, pieces
from egopose.training.contact_network import accuracy_table, draw_views, judging_views, overall, train_contact_network

TINY: dict[str, Any] = {"widths": (16,), "views": 2, "epochs": 2, "batch": 4}
#: The paper's network, as small.
WINDOWS: dict[str, Any] = {"network": "windows", "widths": (32, 16), "batch": 16, "dropout": 0.0}


def settings(**changed: Any) -> ContactSettings:
    shipped = from_mapping(ContactSettings, compose_config("contacts", ["out=x"])["training"], "conf")
    return replace(shipped, **{**TINY, **changed})


def clip() -> ContactClip:
    return contact_clip(default_humanoid(), walking(), settings())


def test_a_walks_contacts_are_those_of_its_feet() -> None:
    walk = clip()
    assert walk.contacts.any(axis=1).mean() > 0.9  # who walks has a foot down
    assert 0.4 < walk.contacts.mean() < 0.9
    assert 1.6 < walk.height < 2.1
    # An ankle whose foot is down is low and slow beside one that swings.
    ankles = walk.points[:, [3, 6]]
    speed = np.linalg.norm(np.gradient(ankles, axis=0), axis=-1) * walk.fps
    assert speed[~walk.contacts].mean() > 3 * speed[walk.contacts].mean()
    assert ankles[..., 2][~walk.contacts].mean() > ankles[..., 2][walk.contacts].mean()


def test_a_foot_that_stands_above_the_floor_is_not_learned_from() -> None:
    walk, shipped = walking(), settings()
    qpos = walk.qpos.copy()
    qpos[:, 2] += 0.05
    raised = contact_clip(default_humanoid(), replace(walk, qpos=qpos), shipped)
    assert not raised.contacts.any()
    assert (raised.doubtful[:-1] >= clip().contacts[:-1]).mean() > 0.8
    assert clip().doubtful.mean() < 0.1
    (view,) = draw_views([raised], settings(views=1))[0]
    np.testing.assert_array_equal(view.known, ~raised.doubtful)


def test_another_body_stands_where_the_first_one_stood() -> None:
    walk = clip()
    other = another_body(walk, 0.2, np.random.default_rng(3))
    np.testing.assert_array_equal(
        another_body(walk, 0.0, np.random.default_rng(3)).points[:, [0, 3, 6]], walk.points[:, [0, 3, 6]]
    )
    np.testing.assert_allclose(another_body(walk, 0.0, np.random.default_rng(3)).points, walk.points, atol=1e-12)
    # Ankles keep their place on the floor, so feet that stood still do.
    np.testing.assert_array_equal(other.points[:, [3, 6], :2], walk.points[:, [3, 6], :2])

    def bones(points: np.ndarray) -> np.ndarray:
        joints = points[:, [1, 2, 3]]
        return np.linalg.norm(np.diff(joints, axis=1), axis=-1).mean(axis=0)

    assert np.abs(bones(other.points) / bones(walk.points) - 1).max() > 0.05
    hips = [np.linalg.norm(points[:, 1] - points[:, 4], axis=-1).mean() for points in (other.points, walk.points)]
    assert abs(hips[0] / hips[1] - 1) > 0.05


def test_keypoints_are_as_wrong_as_asked() -> None:
    walk = clip()
    for level in (0.01, 0.03):
        exact = settings(error=(0.0, 0.0), dropped=0.0)
        noisy = settings(error=(level, level), dropped=0.0, definition=0.0)
        off = []
        for seed in range(12):
            true, seen = (seen_by(walk, "fixed", s, np.random.default_rng(seed)).keypoints for s in (exact, noisy))
            # A body height in the picture, by thigh and shank, which stand at about 0.49 of it.
            leg = np.linalg.norm(true[:, 1] - true[:, 2], axis=-1) + np.linalg.norm(true[:, 2] - true[:, 3], axis=-1)
            off.append(np.linalg.norm(seen - true, axis=-1).mean() / (leg.max() / 0.49))
        assert np.mean(off) == pytest.approx(level, rel=0.35)


@pytest.mark.parametrize("kind", [{"dropout": 0.0, "epochs": 40}, {**WINDOWS, "epochs": 25}])
def test_it_learns_a_walk_and_is_the_same_each_time(kind: dict[str, Any]) -> None:
    clips = [clip()] * 8
    simple = settings(error=(0.0, 0.0), learning_rate=0.01, **kind)
    views = draw_views(clips, simple)
    assert (len(views), len(views[0])) == (2, 8)
    told: list[float] = []
    network = train_contact_network(views, simple, lambda epoch, loss, seconds: told.append(loss))
    assert told[-1] < 0.5 * told[0]
    table = accuracy_table(network, judging_views(clips[:1], simple, 1))
    assert overall(table["undone"]["pan"], clips[:1]) > 0.85
    few = replace(simple, epochs=1)
    one, other = (train_contact_network(draw_views(clips[:2], few), few).state_dict() for _ in range(2))
    assert all(torch.equal(one[name], other[name]) for name in one)
    seeded = train_contact_network(draw_views(clips[:2], few), replace(few, seed=1)).state_dict()
    assert not all(torch.equal(one[name], seeded[name]) for name in one)


def test_pieces_hold_a_clip_and_its_labels() -> None:
    frames = 150
    features = np.random.default_rng(0).normal(size=(frames, 36)).astype(np.float32)
    contacts = np.random.default_rng(1).random((frames, 2)) < 0.5
    for seed in range(5):
        cut = pieces(features, contacts, np.ones_like(contacts), np.random.default_rng(seed))
        assert cut.inputs.shape == (len(cut.inputs), PIECE, 36)
        known = cut.known.all(dim=-1)
        # Places are whole, in order; only ends too short to learn from are left out.
        places = cut.inputs[known][:, :14].numpy()
        start = int(np.flatnonzero((features[:, :14] == places[0]).all(axis=1))[0])
        np.testing.assert_array_equal(places, features[start : start + len(places), :14])
        np.testing.assert_array_equal(cut.contacts[known].numpy(), contacts[start : start + len(places)])
        assert len(places) > frames - 2 * 9
        for row, there in zip(cut.inputs, known, strict=True):
            last = int(there.sum()) - 1
            assert not row[last, 14:28].any()
            assert not row[last + 1 :].any()
            assert row[last - 1, 14:28].all()
    assert len(pieces(features[:5], contacts[:5], contacts[:5], np.random.default_rng(0)).inputs) >= 1


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"cameras": {"drone": 1.0}}, "drone"),
        ({"cameras": {"pan": 0.0}}, "cameras"),
        ({"lasting": 0.8}, "lasting"),
        ({"network": "lstm"}, "network"),
        ({"widths": (64, 64)}, "widths"),
    ],
)
def test_settings_that_cannot_be_are_refused(changed: dict[str, Any], name: str) -> None:
    with pytest.raises(InputError, match=name):
        settings(**changed)


def test_the_command_trains_judges_and_saves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hold_out_the_turn(tmp_path, monkeypatch)
    out = tmp_path / "network"
    words = [f"sources.cmu6={tmp_path / 'mocap'}", "whole=[]", f"out={out}", "training.widths=[16]", "training.views=1"]
    values = compose_config("contacts", [*words, "training.epochs=1", "training.batch=8"])
    train_contacts(values)
    assert "held-out people, camera undone: fixed" in capsys.readouterr().out
    result = json.loads((out / "result.json").read_text())
    assert set(result["accuracy"]["as seen"]) == {"fixed", "pan", "zoom", "track"}
    network = load_contact_network(out / "network")
    assert not network.training
    table = accuracy_table(network, judging_views([clip()], settings(), 0))
    assert 0.0 <= overall(table["as seen"]["fixed"], [clip()]) <= 1.0
    changed = json.loads((config := out / "network" / "components" / "0000-config" / "value.json").read_text())
    config.write_text(json.dumps({**changed, "network": "lstm"}))
    with pytest.raises(InputError):
        load_contact_network(out / "network")
    with pytest.raises(InputError, match="is there already"):
        train_contacts(values)
    with pytest.raises(InputError, match="config-name contacts"):
        load_contact_network(tmp_path / "none")
