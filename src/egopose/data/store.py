"""The memory-mapped store of takes: reference states, flow, features, all with one axis of frames.

A folder::

    store.json            schema, fps, fingerprint of humanoid and preparation, the takes, what of the set was left out,
                          checksums (reference, clips)
    clips/<take>.npz      the reference clips in the project's own format
    videos/<take>.mp4     the wearer's video (rendered, or a link to the user's own)
    reference/            TensorDict [F], float64: the body-state keys
    flow/<name>/          TensorDict [F]: flow [2, S, S] float16; done.json lists the takes that are in
    tables/<name>/        TensorDicts [F] of trained encoders and regressors, each with its card.json and checksums.json

What is read is mapped copy-on-write: a change in place stays in the memory of the process that makes it. Reference,
clips and tables are compared with their SHA-256 once a process, and again once a file's size or times have changed.
Flow and videos, by far the largest, are not. A store from before there were checksums opens as it did.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict
from torch import Tensor

from egopose.core.config import convert, from_mapping
from egopose.core.errors import InputError
from egopose.core.file_digests import sha256_of
from egopose.core.safe_io import read_json
from egopose.core.safe_tensors import load_tensors
from egopose.motion.io import read_motion, write_motion
from egopose.motion.motion import Motion

SCHEMA = 1
_CHECKSUMS = "checksums.json"
#: What every frame of ``reference/`` has; see :func:`egopose.data.reference.reference_states`.
REFERENCE_KEYS = ("qpos", "qvel", "xpos", "xquat", "com", "com_vel")
#: What a take may be for, where its set says so.
PARTS = ("train", "test")


@dataclass(frozen=True)
class TakeInfo:
    """One take's row in ``store.json``.

    Args:
        name: unique in the store.
        subject: whose motion it is.
        offset, length: its frames among the store's.
        lowest_head_height: m, of the reference.
        source: file it came from (name only), with licence.
        video: path of the wearer's video, relative to the store or absolute for a user's own.
        sync_offset: s; what the motion shows at t, the video shows at t + offset.
        rendered: whether the video was rendered from the motion.
        supported: ``[[start, stop], ...]`` frames in which a body on a bare floor could be in.
        retargeting_mm: mean distance of the retargeted joints to their source, mm.
        camera: settings of :class:`egopose.vision.lens.Camera` of a user's own video, or None.
        notes: sentences on how its motion file was read.
        warnings: what is odd about the motion, see :mod:`egopose.motion.plausibility`.
        group: of takes that ``data.shares`` names together.
        part: ``train`` or ``test`` where the set says so; see the split of kind ``table``.
        gate: why the physics gate is not passed, empty where it is; None where it was not asked.
        feasible: share of the frames that contact with a bare floor can have made; None where it was not asked.
    """

    name: str
    subject: str
    offset: int
    length: int
    lowest_head_height: float
    source: str
    video: str
    sync_offset: float
    rendered: bool
    supported: tuple[tuple[int, int], ...]
    retargeting_mm: float
    camera: Any = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    group: str = ""
    part: str = ""
    gate: str | None = None
    feasible: float | None = None


@dataclass(frozen=True)
class LeftOut:
    """A clip of the set that is not in the store.

    Args:
        name: of the clip.
        subject: whose motion it is.
        cause: why it was left out or refused.
        seconds: how long it is, where that is known.
        refused: whether it was tried and could not be used; else the set leaves it out.
    """

    name: str
    subject: str
    cause: str
    seconds: float | None = None
    refused: bool = False


@dataclass(frozen=True)
class Fragment:
    """Frames ``start .. stop - 1`` of one take (in the take's own count)."""

    take: int
    start: int
    stop: int


class TakeStore:
    """An open store; arrays are memory-mapped and read on use.

    Raises:
        InputError: not a store, of another schema, or damaged; names the field.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        path = root / "store.json"
        if not path.is_file():
            raise InputError(
                root, "store.json", "is missing: this is not a take store; make one: python -m egopose.prepare"
            )
        card = read_json(path, "takes")
        if not isinstance(card, dict):
            raise InputError(path, "takes", f"is damaged: cannot be read: {card!r:.60}")
        for key, kind in (("schema", int), ("fps", float), ("fingerprint", str), ("takes", list)):
            if key not in card:
                raise InputError(path, key, "is damaged: it is missing")
            convert(card[key], kind, str(path), key)
        if card["schema"] != SCHEMA:
            raise InputError(
                path, "schema", f"is {card['schema']}, this version reads {SCHEMA}; prepare the data again"
            )
        self.card: dict[str, Any] = card
        self._checksums = _as_checksums(path, card.get("checksums", {}))
        self.fps = float(card["fps"])
        self.takes = tuple(_take_info(path, row, number) for number, row in enumerate(card["takes"]))
        self.left_out = _left_out(path, card.get("left_out", []))
        self.frames_total = 0
        for number, take in enumerate(self.takes):
            if take.offset != self.frames_total:
                cause = f"is {take.offset}, the takes before it end at {self.frames_total}"
                raise InputError(path, f"takes[{number}].offset", cause)
            self.frames_total += take.length

    @classmethod
    def open(cls, root: str | os.PathLike[str]) -> TakeStore:
        """Open the store in a folder."""
        return cls(Path(root))

    @classmethod
    def create(
        cls,
        root: Path,
        fps: float,
        fingerprint: str,
        takes: Sequence[TakeInfo],
        clips: Sequence[Motion],
        states: TensorDict,
        left_out: Sequence[LeftOut] = (),
    ) -> TakeStore:
        """Write a new store; it appears whole, by renaming, and replaces nothing that is there.

        Args:
            root: of the store; must not hold one.
            fps: of all clips.
            fingerprint: of all that the reference depends on.
            takes: rows, offsets in order.
            clips: reference clips, in step with ``takes``.
            states: ``[F]`` body states.
            left_out: clips of the set that are not in the store.
        """
        part = root.with_name(root.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        (part / "clips").mkdir(parents=True)
        (part / "videos").mkdir()
        for take, clip in zip(takes, clips, strict=True):
            write_motion(clip, part / "clips" / f"{take.name}.motion.npz")
        states.memmap(part / "reference")
        checksums = _checksums(part, "clips", "reference")
        rows = [asdict(take) for take in takes]
        card = {"schema": SCHEMA, "fps": fps, "fingerprint": fingerprint, "takes": rows, "checksums": checksums}
        card |= {"left_out": [asdict(clip) for clip in left_out]} if left_out else {}
        (part / "store.json").write_text(json.dumps(card, indent=1))
        os.replace(part, root)
        return cls(root)

    @property
    def fingerprint(self) -> str:
        return str(self.card["fingerprint"])

    @property
    def reference(self) -> TensorDict:
        """Body states ``[F]`` of all takes, float64, memory-mapped.

        Raises:
            InputError: missing, damaged, or altered since it was made.
        """
        states = self._load(self.root / "reference", "reference")
        self._check("reference", self._checksums)
        if missing := set(REFERENCE_KEYS) - set(states.keys()):
            raise InputError(self.root, "reference", f"is damaged: {', '.join(sorted(missing))} missing")
        if len(states) != self.frames_total:
            raise InputError(self.root, "reference", f"has {len(states)} frames, the takes {self.frames_total}")
        return states

    def frames(self, take: int) -> slice:
        """The take's frames among the store's."""
        info = self.takes[take]
        return slice(info.offset, info.offset + info.length)

    def clip(self, take: int) -> Motion:
        """The reference clip of a take. Raises InputError: it was altered since it was made."""
        self._check(f"clips/{self.takes[take].name}.motion.npz", self._checksums)
        return read_motion(self.root / "clips" / f"{self.takes[take].name}.motion.npz")

    def video(self, take: int) -> Path:
        """Path of the wearer's video."""
        return self.root / self.takes[take].video

    def flow(self, name: str) -> Tensor:
        """``[F, 2, S, S]`` float16, memory-mapped.

        Raises:
            InputError: takes are missing from it.
        """
        missing = set(range(len(self.takes))) - self.flow_done(name)
        if missing:
            names = ", ".join(self.takes[i].name for i in sorted(missing)[:5])
            raise InputError(
                self.root / "flow" / name, "done.json", f"lacks {len(missing)} takes ({names} ...): prepare"
            )
        return self._load(self.root / "flow" / name, f"flow/{name}")["flow"]

    def flow_done(self, name: str) -> set[int]:
        """Takes whose flow is in."""
        path = self.root / "flow" / name / "done.json"
        if not path.is_file():
            return set()
        done = read_json(path, "done")
        if not isinstance(done, list) or not all(type(take) is int for take in done):
            raise InputError(path, "done", "is damaged: must be a list of takes' numbers")
        return set(done)

    def open_flow(self, name: str, size: int) -> Tensor:
        """The flow table to be filled, what is written to it goes to its file; made on first use."""
        folder = self.root / "flow" / name
        if not folder.is_dir():
            part = folder.with_name(name + ".part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir(parents=True)
            table = MemoryMappedTensor.zeros(
                (self.frames_total, 2, size, size), dtype=torch.float16, filename=str(part / "flow.memmap")
            )
            TensorDict({"flow": table}, batch_size=[self.frames_total]).memmap_(part)
            os.replace(part, folder)
        return self._load(folder, f"flow/{name}", writable=True)["flow"]

    def mark_flow(self, name: str, take: int) -> None:
        """Note that a take's flow is in."""
        path = self.root / "flow" / name / "done.json"
        part = path.with_suffix(".part")
        part.write_text(json.dumps(sorted(self.flow_done(name) | {take})))
        os.replace(part, path)

    def has_table(self, name: str) -> bool:
        return (self.root / "tables" / name / "card.json").is_file()

    def table(self, name: str) -> TensorDict:
        """Tensors ``[F, ...]`` of a trained encoder or regressor, memory-mapped.

        Raises:
            InputError: missing, damaged, or altered since it was made.
        """
        tensors = self._load(self.root / "tables" / name, f"tables/{name}")
        path = self.root / "tables" / name / _CHECKSUMS
        if path.is_file():
            self._check(f"tables/{name}", _as_checksums(path, read_json(path, "checksums")))
        return tensors

    def table_card(self, name: str) -> dict[str, Any]:
        """What the table's maker noted about it."""
        path = self.root / "tables" / name / "card.json"
        if not path.is_file():
            raise InputError(self.root, f"tables/{name}", "is missing")
        return read_json(path, "card")

    def write_table(self, name: str, tensors: dict[str, Tensor], card: dict[str, Any]) -> None:
        """Store a table whole, by renaming; one of the same name is replaced.

        Raises:
            ValueError: a tensor's first axis is not the store's frames.
        """
        for key, tensor in tensors.items():
            if len(tensor) != self.frames_total:
                raise ValueError(f"{key} has {len(tensor)} frames, the store {self.frames_total}")
        folder = self.root / "tables" / name
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        TensorDict(dict(tensors), batch_size=[self.frames_total]).memmap(part)
        (part / "card.json").write_text(json.dumps(card, indent=1))
        checksums = {f"tables/{name}/{file}": digest for file, digest in _checksums(part, ".").items()}
        (part / _CHECKSUMS).write_text(json.dumps(checksums, indent=1))
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(part, folder)

    def _load(self, folder: Path, field: str, writable: bool = False) -> TensorDict:
        if not folder.is_dir():
            raise InputError(self.root, field, "is missing: python -m egopose.prepare makes it")
        return load_tensors(folder, field, writable=writable)

    def _check(self, part: str, checksums: dict[str, str]) -> None:
        """The files of ``part``, a file or a folder of the store, must be those that were written."""
        for name, digest in checksums.items():
            if name != part and not name.startswith(f"{part}/"):
                continue
            file = self.root / name
            if file.is_file() and sha256_of(file) != digest:  # one that is missing is missed by who reads it
                away = f"{self.root / part}" if part.startswith("tables/") else f"{self.root}"
                cause = f"was altered since it was made: delete {away}, and it is made anew"
                raise InputError(self.root, name, cause)


def _checksums(root: Path, *parts: str) -> dict[str, str]:
    """SHA-256 of every file under ``parts`` of a folder, by its name there."""
    files = (file for part in parts for file in sorted((root / part).rglob("*")) if file.is_file())
    return {file.relative_to(root).as_posix(): sha256_of(file) for file in files}


def _as_checksums(path: Path, value: Any) -> dict[str, str]:
    """What stands in a file for checksums; names that lead out of the store are refused."""
    if not isinstance(value, dict) or not all(isinstance(digest, str) for digest in value.values()):
        raise InputError(path, "checksums", "is damaged: must be the SHA-256 of each file")
    for name in value:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise InputError(path, "checksums", f"is damaged: {name!r:.60} lies outside the store")
    return value


def _take_info(path: Path, row: Any, number: int) -> TakeInfo:
    """A row of ``store.json``; what is written by its names stays inside the store."""
    where = f"takes[{number}]"
    if not isinstance(row, dict):
        raise InputError(path, where, f"cannot be read: {row!r:.60}")
    try:
        take = from_mapping(TakeInfo, row, "takes")
    except InputError as error:
        raise InputError(path, f"{where}.{error.field}", error.cause) from None
    if not (0 <= take.offset < 2**40 and 0 <= take.length < 2**40):
        raise InputError(path, where, f"cannot be read: {take.length} frames from {take.offset} on")
    parts = Path(take.video).parts
    inside = bool(parts) and not Path(take.video).is_absolute() and ".." not in parts
    if take.name in ("", ".", "..") or re.search(r"[/\\\0]", take.name) or (take.rendered and not inside):
        raise InputError(path, where, f"{take.name!r:.60}, {take.video!r:.60}: lies outside the store")
    if take.camera is not None and not isinstance(take.camera, dict):
        raise InputError(path, f"{where}.camera", f"must be settings of a camera, not {take.camera!r:.60}")
    return take


def _left_out(path: Path, rows: Any) -> tuple[LeftOut, ...]:
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(path, "left_out", f"is damaged: must be a list of clips, not {rows!r:.60}")
    return tuple(from_mapping(LeftOut, row, f"{path}: left_out") for row in rows)
