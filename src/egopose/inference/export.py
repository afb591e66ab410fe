"""``python -m egopose.export MOTION_OR_EVALUATION to=FILE [to=FILE ...] [key=value ...]``: motions for other programs.

The ending of each FILE says the format: .bvh .glb .amass.npz .trc .c3d .mot .forces.mot .torques.sto .csv .npz. Of an
evaluation (a folder of `egopose evaluate`) every take is written; FILE then holds {take}. Of a reconstruction (a folder
with plan.npz) the simulated motion is written with the simulation's own forces, and .numbers.csv holds its figures.
Further words are overrides of conf/export.yaml: options.up=z, part=reference, forces.enabled=false ...
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.checkpoint.checkpoint import read_json as read_part
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.core.path_settings import Kind, checked_path
from egopose.core.safe_io import read_json
from egopose.data.preparation import humanoid_of
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.replayed_forces import every_step
from egopose.inference.reconstruction import (
    Reconstruction,
    read_reconstruction,
    reconstruction_folder,
    simulated_humanoid,
)
from egopose.motion.io import WRITERS, given_options, read_motion, write_motion, writer_suffix
from egopose.motion.motion import Motion
from egopose.motion.notes import tell_notes
from egopose.motion.plausibility import source_findings, tell
from egopose.scene.movement_numbers import write_numbers_csv

_SOURCE = "conf/export.yaml"
#: Endings of what cannot be written without forces, and of what holds them besides.
_ONLY_FORCES, _HOLD_FORCES = (".forces.mot", ".torques.sto"), (".glb", ".c3d", ".csv", ".npz")
#: The ending of a reconstruction's figures: a table, no motion.
NUMBERS = ".numbers.csv"


def run_export(source: Path, files: Sequence[str], config: Mapping[str, Any]) -> list[Path]:
    """Write the motion, or all motions of an evaluation, to every file.

    Args:
        source: a motion file that :func:`egopose.motion.io.read_motion` knows, a folder of `egopose evaluate` or
            `egopose estimate`, or a reconstruction: its folder or the ``plan.npz`` in it.
        files: names to write; ``{take}`` in them becomes the take's name, of a reconstruction its folder's.
        config: resolved ``conf/export.yaml``.

    Returns:
        What was written.

    Raises:
        InputError: the source or a setting cannot be used, a file's ending is unknown, or the format cannot hold the
            motion; names it.
    """
    if not files:
        raise InputError("export", "to", f"says no file; endings are {', '.join([*WRITERS, NUMBERS])}")
    _check_part(str(config["part"]))
    found = _reconstruction(source, config)
    numbers = [file for file in files if file.lower().endswith(NUMBERS)]
    if numbers and found is None:
        raise InputError(source, "to", f"{NUMBERS} needs a reconstruction: a folder with plan.npz")
    suffixes = {file: writer_suffix(Path(file)) for file in files if file not in numbers}
    options = known_options(config["options"], set(suffixes.values()))
    enabled = config["forces"]["enabled"]
    if enabled not in ("auto", True, False):
        raise InputError(_SOURCE, "forces.enabled", f"must be auto, true or false, not {enabled!r}")
    needed = any(suffix in _ONLY_FORCES for suffix in suffixes.values())
    held = any(suffix in _HOLD_FORCES for suffix in suffixes.values())
    written = []
    for take, path, motion in _motions(source, found, files, config):
        tell_notes(take, motion, lambda line: print(line, file=sys.stderr))
        if enabled is not False and (needed or held) and motion.ground_reaction is None:
            motion = _with_forces(motion, source, config, required=needed or enabled is True)
        for file in files:
            target = Path(file.replace("{take}", take))
            if target.exists() and target.samefile(path):
                raise InputError(target, "to", "is the motion itself, which stays as it is; give another name")
            target.parent.mkdir(parents=True, exist_ok=True)
            if found is not None and file in numbers:
                write_numbers_csv(found.numbers.rows(), target)
            else:
                suffix = suffixes[file]
                chosen = {k: v for k, v in options.items() if k in _keywords(suffix)}
                _write(motion, path, target, suffix, chosen)
            written.append(target)
    return written


def _reconstruction(source: Path, config: Mapping[str, Any]) -> Reconstruction | None:
    """None where the source is none."""
    given = config["simulated"]
    simulated = None if given is None else Path(checked_path(given, Kind.FILE, "simulated"))
    folder = reconstruction_folder(source, simulated)
    if folder is None:
        if simulated is not None:
            raise InputError(source, "simulated", "needs the folder of a prepared clip beside it")
        return None
    return read_reconstruction(folder, simulated_humanoid(str(config["forces"]["humanoid"])), simulated)


def _motions(
    source: Path, found: Reconstruction | None, files: Sequence[str], config: Mapping[str, Any]
) -> Iterator[tuple[str, Path, Motion]]:
    """Name, file and motion of every take."""
    if found is not None and config["part"] == "estimate":
        if config["rate"] not in ("control", "physics"):
            raise InputError(_SOURCE, "rate", f"must be control or physics, not {config['rate']!r}")
        stepwise = config["rate"] == "physics"
        motion = every_step(found.humanoid, found.forces, found.motion.name) if stepwise else found.motion
        yield found.folder.resolve().name, found.path, motion
        return
    if found is not None:
        files_of = {found.folder.resolve().name: found.folder / "body.npz"}
    else:
        files_of = motion_files(source, str(config["part"]), config["take"])
    if len(files_of) > 1 and (same := [f for f in files if "{take}" not in f]):
        raise InputError(source, "to", f"{len(files_of)} takes would all go to {same[0]}; put {{take}} into the name")
    for take, path in files_of.items():
        motion = read_motion(path, **(given_options(config["reader"]) if path == source else {}))
        if path == source:
            tell(source_findings(motion), take, lambda line: print(line, file=sys.stderr))
        yield take, path, motion


def _write(motion: Motion, path: Path, target: Path, suffix: str, options: Mapping[str, Any]) -> None:
    try:
        write_motion(motion, target, **options)
    except InputError:
        raise
    except KeyError as error:
        raise InputError(target, "options", f"{error} is no unit or axis of this format") from None
    except ValueError as error:
        raise InputError(target, suffix, f"cannot hold {path}: {error}") from None


def _check_part(part: str) -> None:
    if part not in ("estimate", "reference"):
        raise InputError(_SOURCE, "part", f"must be estimate or reference, not {part!r}")


def motion_files(source: Path, part: str, take: str | None) -> dict[str, Path]:
    """Motion files by take's name: of one file, of an estimate's folder, or of an evaluation's.

    Raises:
        InputError: the folder holds none, or not the take or part asked for.
    """
    if not source.exists():
        raise InputError(source, "path", "no such file or folder")
    if not source.is_dir():
        return {source.name.split(".")[0]: source}
    takes = {path.parent.name: path for path in sorted(source.glob(f"takes/*/{part}.npz"))}
    if not takes and (source / f"{part}.npz").is_file():
        takes = {source.resolve().name: source / f"{part}.npz"}
    if not takes:
        raise InputError(source, part, f"no takes/NAME/{part}.npz in it; `egopose evaluate` writes them")
    if take is None:
        return takes
    if take not in takes:
        raise InputError(source, "take", f"no take {take!r}; there are {', '.join(takes)}")
    return {take: takes[take]}


def known_options(options: Mapping[str, Any], suffixes: set[str]) -> dict[str, Any]:
    """``options`` as they are.

    Raises:
        InputError: one that none of the writers has.
    """
    known = set().union(*(_keywords(suffix) for suffix in suffixes))
    for name in options:
        if name not in known:
            has = ", ".join(sorted(known)) or "none"
            raise InputError(_SOURCE, f"options.{name}", f"no format asked for has it; options here: {has}")
    return dict(options)


def _keywords(suffix: str) -> set[str]:

    return set(WRITERS[suffix].__kwdefaults__ or ())


def _with_forces(motion: Motion, source: Path, config: Mapping[str, Any], *, required: bool) -> Motion:
    """The motion with forces; as it is, and a word on standard error, where they are not required and cannot be had."""
    chosen = dict(config["forces"])
    enabled, choice = chosen.pop("enabled"), str(chosen.pop("humanoid"))
    settings = from_mapping(ForceSettings, chosen, f"{_SOURCE}: forces")
    try:
        return with_forces(humanoid_for(source, choice), motion, settings)
    except InputError as error:
        if required:
            raise
        print(f"no torques and ground reaction (forces.enabled={enabled}): {error}", file=sys.stderr)
        return motion


def humanoid_for(source: Path, choice: str) -> HumanoidModel:
    """The humanoid of the run an evaluation is of; else the one of ``conf/humanoid/CHOICE``.

    Raises:
        InputError: the evaluation's run is gone, or there is no such choice.
    """
    results = source / "results.json"
    if source.is_dir() and results.is_file():
        checkpoints = read_json(results, "results").get("checkpoints")
        if not isinstance(checkpoints, list) or not checkpoints or not Path(str(checkpoints[0])).is_dir():
            raise InputError(results, "checkpoints", "the run it names is not there; its humanoid's masses are unknown")
        return humanoid_of(read_part(Path(str(checkpoints[0])), "config"))
    return humanoid_of(compose_config("train", [f"humanoid={choice}"]))
