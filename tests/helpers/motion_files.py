"""Motion files of one squatting person, written as other programs write them, for the tests of readers."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget
from egopose.motion.rotations import Array
from helpers.mocap import default_humanoid


@dataclass(frozen=True)
class Bvh:
    """A BVH file in parts: the text of the hierarchy, the frame time as written, and rows of numbers."""

    hierarchy: str
    frame_time: str
    rows: Array

    @classmethod
    def read(cls, path: Path) -> Bvh:
        """A well-formed file."""
        hierarchy, motion = path.read_text().split("MOTION\n")
        _, frame_time, *rows = motion.strip().split("\n")
        return cls(hierarchy, frame_time.split(":")[1].strip(), np.array([row.split() for row in rows], dtype=float))

    def text(self, announced: int | None = None, decimals: int = 5) -> str:
        """The file; ``announced`` frames in place of how many there are."""
        rows = "\n".join(" ".join(f"{v:.{decimals}f}" for v in row) for row in self.rows)
        frames = len(self.rows) if announced is None else announced
        return f"{self.hierarchy}MOTION\nFrames: {frames}\nFrame Time: {self.frame_time}\n{rows}\n"

    def renamed(self, rename: Callable[[str], str]) -> Bvh:
        """With other names of the joints."""
        pattern = re.compile(r"(?<=ROOT |OINT )(\w+)")
        return replace(self, hierarchy=pattern.sub(lambda match: rename(match[1]), self.hierarchy))

    def scaled(self, factor: float) -> Bvh:
        """With other lengths."""
        rows = self.rows.copy()
        rows[:, :3] *= factor

        def scale(match: re.Match[str]) -> str:
            return "OFFSET " + " ".join(f"{float(v) * factor:.7f}" for v in match[1].split())

        return replace(self, hierarchy=re.sub(r"OFFSET (.*)", scale, self.hierarchy), rows=rows)

    def with_six_channels(self, positions: Callable[[Array], Array]) -> Bvh:
        """With positions of every joint: ``positions`` of its OFFSET."""
        offsets = [np.array(v.split(), dtype=float) for v in re.findall(r"OFFSET (.*)\n\s*CHANNELS", self.hierarchy)]
        added = "CHANNELS 6 Xposition Yposition Zposition "
        hierarchy = self.hierarchy.replace("CHANNELS 3 ", added)
        columns = [self.rows[:, :6]]
        for i, offset in enumerate(offsets[1:]):
            moved = np.tile(positions(offset), (len(self.rows), 1))
            columns += [moved, self.rows[:, 6 + 3 * i : 9 + 3 * i]]
        return replace(self, hierarchy=hierarchy, rows=np.concatenate(columns, axis=1))


def parts_positions(motion: Motion, frames: int = 12) -> Array:
    """``[frames, J, 3]`` m: the humanoid's joints with some of the motion's frames retargeted to it."""
    at = np.linspace(0, len(motion) - 1, frames).astype(int)
    humanoid = default_humanoid()
    part = replace(motion, qpos=motion.qpos[at])
    return retarget(part, humanoid.skeleton, humanoid.joint_range)[0].forward_kinematics()[0]


@lru_cache
def plain(path: Path) -> Bvh:
    """``plain.bvh`` of the cases."""
    return Bvh.read(path)
