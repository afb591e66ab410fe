"""The default humanoid and real files of every rig, for the tests of retargeting, humanoid and data."""

from __future__ import annotations

import shutil
import tarfile
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from egopose.core.config import compose_config
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.pipeline import mocap_sources

#: A file of each rig under ``shared/data``; a tar's member after the colon.
RIGS = {
    "cc_base": "cmu_bvh60/subjects/002/002_01.bvh",
    "cmu31": "cmu_bvh120/01_01.bvh",
    "acclaim": "cmu_amc/01_01.amc",
    "deepmimic": "deepmimic/humanoid3d_walk.txt",
    "bandai": "bandai1_ccbync4.tar.xz:dataset-1_walk_normal_001.bvh",
}


@lru_cache
def default_config() -> HumanoidConfig:
    """``conf/humanoid/default.yaml``."""
    return HumanoidConfig.from_mapping(compose_config("prepare")["humanoid"])


@lru_cache
def default_humanoid(substeps: int = 15) -> HumanoidModel:
    """The default humanoid at 30 Hz control."""
    return build_humanoid(default_config(), SimConfig(substeps=substeps))


#: Two short clips among those that ship with the package.
SHORT_CLIPS = ("deepmimic_turn_left0", "deepmimic_walk")


def short_clips(folder: Path) -> list[str]:
    """Two short embedded clips as a set of one's own below ``folder``; the overrides that name it and its store."""
    source = folder / "mocap"
    if not source.is_dir():
        source.mkdir(parents=True)
        for name in SHORT_CLIPS:
            shutil.copy(Path(str(files("egopose") / "assets" / "clips")) / f"{name}.motion.npz", source)
    return [
        "data=cmu6",
        f"data.folder={source}",
        "data.pattern='*.motion.npz'",
        "data.subject='deepmimic_([a-z]+)'",
        f"data.store={folder / 'store'}",
        "sim=fast",
    ]


def hold_out_the_turn(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ``sources.cmu6=FOLDER/mocap`` be :func:`short_clips`, whose turn is held out."""
    composed = compose_config("train", short_clips(folder))
    composed["data"]["split"] = {"kind": "subject", "test_subjects": ["turn"], "shortest": 8, "subjects": None}
    monkeypatch.setattr(mocap_sources, "compose_config", lambda name, words: composed)


def rig_motion(rig: str, shared: Path, folder: Path, seconds: float = 6.0) -> Motion:
    """The first seconds of one rig's file at 30 fps, without a T-pose before it; tars are unpacked into ``folder``."""
    return _excerpt(RIGS[rig], shared, folder, seconds)


def _excerpt(place: str, shared: Path, folder: Path, seconds: float) -> Motion:
    from egopose.data.prepare_motion import without_lead_in

    name, _, member = place.partition(":")
    path, options = shared / "data" / name, dict[str, Any]()
    if member:
        path = extract_member(path, member, folder)
    motion = without_lead_in(read_motion(path, **options))
    return motion.resample(30.0).slice(0, round(30 * seconds))


def extract_member(archive: Path, name: str, folder: Path) -> Path:
    """The file called ``name`` out of a tar, written to ``folder``."""
    target = folder / name
    if not target.exists():
        with tarfile.open(archive) as tar:
            for member in tar:
                if Path(member.name).name == name:
                    stream = tar.extractfile(member)
                    assert stream is not None
                    target.write_bytes(stream.read())
                    break
    return target
