"""``python -m egopose.export MOTION_OR_EVALUATION to=FILE [to=FILE ...] [key=value ...]``: motions for other programs.

The ending of each FILE says the format: .bvh .glb .amass.npz .trc .c3d .mot .forces.mot .torques.sto .csv .npz. Of an
evaluation (a folder of `egopose evaluate`) every take is written; FILE then holds {take}. Of a reconstruction (a folder
with plan.npz) the simulated motion is written with the simulation's own forces, and .numbers.csv holds its figures.
Further words are overrides of conf/export.yaml: options.up=z, part=reference, forces.enabled=false, and for reading the
motion reader.up=y ...
"""

from __future__ import annotations

import sys
from pathlib import Path

from egopose.core.config import check_arguments, compose_config
from egopose.core.errors import InputError
from egopose.core.path_settings import Kind, checked_path


def main() -> None:
    """The command."""
    words = sys.argv[1:]
    if not words or any(word in ("-h", "--help") for word in words):
        print(__doc__)
        raise SystemExit(0 if words else 2)
    sources = [word for word in words if "=" not in word]
    files = [word.removeprefix("to=") for word in words if word.startswith("to=")]
    overrides = [word for word in words if "=" in word and not word.startswith("to=")]
    # An unknown option is told by the writers, which know their own.
    overrides = [f"+{word}" if word.startswith("options.") else word for word in overrides]
    try:
        check_arguments(words)
        if len(sources) != 1:
            raise InputError("export", "source", f"takes one motion or evaluation, not {len(sources)}: {sources}")
        source = checked_path(sources[0], Kind.EXISTING, "source")
        files = [checked_path(file, Kind.NEW_FILE, "to") for file in files]

        from egopose.inference.export import run_export

        for path in run_export(Path(source), files, compose_config("export", overrides)):
            print(path)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
