"""TRC, OpenSim's marker file: tab-separated positions of joints and limb ends, y up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import UNITS, up_rotation
from egopose.motion.io.markers import markers
from egopose.motion.motion import Motion


def write_trc(motion: Motion, path: str | Path, *, unit: str = "mm", up: str = "y") -> None:
    """Write joint centres and tips as markers; rotations, contacts, torques and forces have no place in a TRC.

    Args:
        motion: z up, metres.
        path: the file; its folder must exist.
        unit: ``"mm"`` or ``"m"``, which OpenSim reads.
        up: the file's up axis; OpenSim's is y.

    Raises:
        KeyError: an unknown unit or up axis.
    """
    path = Path(path)
    names, positions = markers(motion)
    values = rot.rotate(rot.conjugate(up_rotation(up)), positions) / UNITS[unit]
    frames, count = values.shape[:2]
    rate = f"{motion.fps:.10g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{count}\t{unit}\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k}" for k in range(1, count + 1) for axis in "XYZ"),
        "",
    ]
    digits = 6 - round(np.log10(UNITS["m"] / UNITS[unit]))  # micrometres, whatever the unit
    row_format = "\t".join([f"%.{digits}f"] * (3 * count))
    lines += [
        f"{t + 1}\t{t / motion.fps:.9g}\t" + row_format % tuple(row)
        for t, row in enumerate(values.reshape(frames, -1).tolist())
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
