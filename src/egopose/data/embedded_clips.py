"""Rebuild the embedded clips from their published sources::

    python -m egopose.data.embedded_clips --assimp DIR --pybullet DIR --cmu60 DIR

``--assimp``: ``models/BVH`` of Debian's ``assimp-testmodels``; ``--pybullet``: ``pybullet_data/data/motions`` out of
the PyPI wheel of pybullet 3.2.7; ``--cmu60``: the 60 fps BVH re-export of CMU mocap (folder ``subjects``).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from egopose.data.prepare_motion import without_lead_in
from egopose.motion.io import read_motion
from egopose.motion.io.native import write_native

#: Enough for any joint of a walking or jumping person, at a size a wheel can carry.
_FPS = 60.0
_LICENCES = {
    "cmu": "CMU Graphics Lab Motion Capture Database: free for research and commercial use",
    "deepmimic": "pybullet_data (zlib licence), from DeepMimic (MIT)",
}


def sources(assimp: Path, pybullet: Path, cmu60: Path) -> Iterator[tuple[str, Path]]:
    """Name and file of every embedded clip."""
    for trial in ("01_01", "01_03"):
        yield f"cmu01_{trial[3:]}", assimp / f"{trial}.bvh"
    for number in range(2, 11):
        yield f"cmu07_{number:02}", cmu60 / "007" / f"007_{number:02}.bvh"
    for clip in ("walk", "cartwheel"):
        yield f"deepmimic_{clip}", pybullet / f"humanoid3d_{clip}.txt"
    for clip in ("0walk_forward", "turn_left0", "turn_left1", "turn_right0", "turn_right1"):
        yield f"deepmimic_{clip.lstrip('0')}", pybullet / "walker" / f"{clip}.txt"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("assimp", "pybullet", "cmu60"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    folder = Path(__file__).resolve().parents[1] / "assets" / "clips"
    folder.mkdir(exist_ok=True)
    seconds = 0.0
    for name, path in sources(**vars(parser.parse_args())):
        motion = without_lead_in(read_motion(path))
        motion = motion.resample(min(_FPS, motion.fps))
        meta = {**motion.meta, "licence": _LICENCES["cmu" if name.startswith("cmu") else "deepmimic"]}
        write_native(replace(motion, name=name, meta=meta), folder / f"{name}.motion.npz", dtype="float32")
        seconds += motion.duration
        print(f"{name}: {motion.duration:.1f} s")
    print(f"{seconds:.0f} s in {folder}")


if __name__ == "__main__":
    main()
