"""`egopose reconstruct` behind the preparation: what is left in the folder, and that nothing is made twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.filmed_walk import filmed_walk

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.inference import scene_recovery
from egopose.inference.reconstruction import read_reconstruction, simulated_humanoid
from egopose.inference.scene_preparation import prepare_scene
from egopose.inference.scene_recovery import FITTED, PAGE, PLAN, SEARCH, recover_scene
from egopose.scene.scene_file import read_scene
from egopose.scene.simulated import load_simulated

SMALL = tuple(
    f"refinement.{word}" for word in ("sweeps=1", "window=6", "knots=6", "changed=6", "iterations=1", "threads=1")
)


def settings(folder: Path, *more: str) -> dict[str, Any]:
    words = [f"out={folder / 'out'}", f"poses={folder / 'walk.npz'}", *SMALL, *more]
    return compose_config("reconstruct", words)


def report(folder: Path, page: Path) -> None:
    page.write_text(f"of {folder.name}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("walk")
    track, _ = filmed_walk(pitch=0.15)
    track.save(out / "walk.npz")
    prepare_scene(settings(out), lambda *args: (args[-1] / "page.html").write_text("page"))
    recover_scene(settings(out), out / "out", report)
    return out


def test_a_motion_a_scene_and_a_page_are_left(folder: Path) -> None:
    out = folder / "out"
    assert all((out / name).is_file() for name in (PLAN, FITTED, SEARCH, PAGE))
    assert read_scene(out / FITTED).boxes == ()
    # Physics plays it again, or it would be refused.
    found = read_reconstruction(out, simulated_humanoid())
    assert len(found.motion) == len(load_simulated(out / PLAN))


def test_a_second_call_makes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: object, **more: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr(scene_recovery, "recovered", never)
    recover_scene(settings(folder), folder / "out", never)
    with pytest.raises(AssertionError, match="made again"):
        recover_scene(settings(folder, "refinement.reach=0.5"), folder / "out", never)


def test_a_search_that_breaks_off_leaves_the_last_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (folder / "out" / PLAN).read_bytes()

    def full(*args: object, **more: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(scene_recovery, "_keep", full)
    with pytest.raises(OSError, match="full"):
        recover_scene(settings(folder, "refinement.reach=0.4"), folder / "out", report)
    assert (folder / "out" / PLAN).read_bytes() == before


def test_a_box_that_only_the_scene_knows_is_told_in_the_fitted_scene(folder: Path) -> None:
    """A box far away: nobody comes near it, so that it may stand anywhere."""
    scene = {"boxes": [{"name": "far", "size": [1.0, 1.0], "place": [9.0, 9.0], "height": 0.3, "yaw": 0.0}]}
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    values = settings(folder, f"scene={folder / 'scene.yaml'}", f"out={folder / 'boxed'}", "fit=false")
    prepare_scene(values, lambda *args: (args[-1] / "page.html").write_text("page"))
    recover_scene(values, folder / "boxed", report)
    (box,) = read_scene(folder / "boxed" / FITTED).boxes
    assert box.place == (9.0, 9.0)
    assert box.height == pytest.approx(0.3)


def test_settings_are_read_before_anything_is_searched(folder: Path) -> None:
    with pytest.raises(InputError, match="advance"):
        recover_scene(settings(folder, "refinement.advance=99"), folder / "out", report)
    with pytest.raises(InputError, match="none-such"):
        recover_scene(settings(folder, "policy=none-such"), folder / "out", report)
