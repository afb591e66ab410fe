"""From motions to a trained body-part estimator: pictures of bodies are drawn, and the network learns from them."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from glob import glob
from pathlib import Path
from typing import Any

import torch

from egopose.checkpoint.checkpoint import read_json
from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.rotations import Array
from egopose.training.body_parts import (
    BodyPartSettings,
    Pictures,
    bodiless_figures,
    held_out_figures,
    save_body_part_estimator,
    train_body_part_estimator,
)
from egopose.vision.bodiless_pictures import KINDS, bodiless_pictures
from egopose.vision.body_part_pictures import PictureSettings, Scenes, draw_pictures, read_pictures
from egopose.vision.flow import FlowConfig, FlowEstimator
from egopose.vision.takes import RenderConfig


def motion_files(motions: Sequence[str], exclude: Sequence[str]) -> list[Path]:
    """The files that paths and patterns name, sorted, without those whose name fits a pattern of ``exclude``.

    Raises:
        InputError: one names no file; nothing is left; two files have one name.
    """
    result: set[Path] = set()
    for pattern in motions:
        there = [Path(path) for path in glob(str(Path(pattern).expanduser())) if Path(path).is_file()]
        if not there:
            raise InputError(pattern, "motions", "there is no such file")
        result.update(there)
    kept = sorted(path for path in result if not any(fnmatch(path.name, one) for one in exclude))
    if not kept:
        raise InputError("conf/body_parts.yaml", "motions", "exclude leaves none")
    names = [path.name for path in kept]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError("conf/body_parts.yaml", "motions", f"two files are called {twice[0]}")
    return kept


def base_clips(
    files: Sequence[Path], humanoid: HumanoidModel, preparation: Mapping[str, Any], least_frames: int
) -> dict[str, Array]:
    """The motions on the humanoid, qpos ``[T, nq]`` by name; those shorter than ``least_frames`` are left out.

    Raises:
        InputError: a file cannot be read or is of no humanoid; all are too short.
    """
    settings = PreparationSettings.from_mapping(preparation)
    out = {}
    for path in files:
        motion = read_motion(path)
        try:
            clip, report = reference_motion(motion, humanoid, settings)
        except ValueError as error:
            cause = error.cause if isinstance(error, InputError) else str(error)
            raise InputError(path, "motion", cause) from None
        for line in report.warnings:
            print(f"warning: {path.name}: {line}", file=sys.stderr)
        if len(clip) >= least_frames:
            out[path.name] = clip.qpos
    if not out:
        raise InputError(
            "conf/body_parts.yaml", "motions", f"all are shorter than pictures.least_frames={least_frames}"
        )
    return out


def make_body_part_estimator(values: Mapping[str, Any]) -> dict[str, Any]:
    """Run ``conf/body_parts.yaml``, resolved; returns the estimator's card. What is there already is not made again.

    Raises:
        InputError: a motion or a setting cannot be used, or ``out`` holds what others made.
    """
    out, seed = Path(str(values["out"])).expanduser(), convert(values["seed"], int, "conf/body_parts.yaml", "seed")
    pictures = PictureSettings.from_config(values["pictures"])
    training = BodyPartSettings.from_config(values["training"])
    motions = convert(values["motions"], tuple[str, ...], "conf/body_parts.yaml", "motions")
    bodiless = convert(values["bodiless"], int, "conf/body_parts.yaml", "bodiless")
    if bodiless < 1:
        raise InputError("conf/body_parts.yaml", "bodiless", f"must be at least 1, not {bodiless}")
    files = motion_files(motions, convert(values["exclude"], tuple[str, ...], "conf/body_parts.yaml", "exclude"))
    humanoid = humanoid_of(values)
    made_from = {"motions": {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}}

    clips = base_clips(files, humanoid, values["data"]["preparation"], pictures.least_frames)
    scenes = Scenes(
        humanoid.xml,
        humanoid.skeleton,
        humanoid.joint_range,
        tuple(clips.values()),
        RenderConfig.from_mapping(values["vision"]),
        FlowConfig(**values["vision"]["flow"]),
        pictures,
    )
    draw_pictures(
        scenes, seed, out / "pictures", made_from, convert(values["workers"], int, "conf/body_parts.yaml", "workers")
    )

    read = read_pictures(out / "pictures", pictures, ("pictures", "flow", "masks", "posture"))
    data = Pictures(**{name: torch.from_numpy(array) for name, array in read.items()})
    first_held_out = len(data) - max(1, round(training.held_out * len(data)))
    card = {
        **made_from,
        "seed": seed,
        "pictures": dict(values["pictures"]),
        "training": dict(values["training"]),
        "samples": len(data),
        "held_out": len(data) - first_held_out,
    }
    if (out / "finder").is_dir():
        known = read_json(out / "finder", "card")
        if {key: known.get(key) for key in card} != card:
            raise InputError(out, "out", "holds a finder of other settings: remove its finder/ or name another folder")
        return dict(known)

    def tell(steps: int, total: int, loss: float) -> None:
        print(f"step {steps} of {total}, loss {loss:.4f}", file=sys.stderr, flush=True)

    model = train_body_part_estimator(
        data.rows(slice(0, first_held_out)), humanoid.skeleton, training, seed, out / "training", tell
    )
    held_out = data.rows(slice(first_held_out, len(data)))
    card["figures"] = held_out_figures(model, held_out, humanoid.skeleton, training.batch)
    flow = FlowEstimator(scenes.flow)
    card["without a body"] = {}
    for kind in KINDS:
        without, moved = bodiless_pictures(kind, seed, bodiless, scenes.render, flow)
        seen = torch.from_numpy(without), torch.from_numpy(moved)
        card["without a body"][kind] = bodiless_figures(model, *seen, training.batch)
    save_body_part_estimator(
        out / "finder", model, humanoid.skeleton, scenes.flow, card, steps=round(training.epochs * len(data))
    )
    shutil.rmtree(out / "training", ignore_errors=True)
    return card


def train_body_parts(values: Mapping[str, Any]) -> None:
    """:func:`make_body_part_estimator`, and what it found on the terminal.

    Raises:
        InputError: see there.
    """
    card = make_body_part_estimator(values)
    print(f"{card['held_out']} held-out pictures; share of the variance that is explained:")
    for group, figures in card["figures"].items():
        print(f"{group}: " + ", ".join(f"{name} {value:.2f}" for name, value in figures.items()))
    for kind, figures in card.get("without a body", {}).items():
        print(f"{kind} without a body: {figures['false']:.3f} of the cells taken for one")
    print(f"finder: {Path(str(values['out'])) / 'finder'}")
