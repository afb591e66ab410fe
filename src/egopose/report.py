"""``python -m egopose.report FOLDER [out=FILE] [key=value ...]``: one HTML page that holds everything it shows.

FOLDER is one of `egopose evaluate`, a sweep's (``hydra.sweep.dir``), or a reconstruction's. Further words are overrides
of conf/report.yaml. `egopose evaluate ... report=true` makes the same page of what it has just found.
"""

from __future__ import annotations

import sys
from pathlib import Path

from egopose.core.config import check_arguments
from egopose.core.errors import InputError
from egopose.core.path_settings import Kind, checked_path


def main() -> None:
    """The command."""
    words = sys.argv[1:]
    if not words or any(word in ("-h", "--help") for word in words):
        print(__doc__)
        raise SystemExit(0 if words else 2)
    folders = [word for word in words if "=" not in word]
    try:
        check_arguments(words)
        if len(folders) != 1:
            raise InputError("report", "folder", f"takes one folder, not {len(folders)}: {folders}")
        folder = checked_path(folders[0], Kind.FOLDER, "folder")

        from egopose.evaluation.reports import run_report

        print(run_report(Path(folder), [word for word in words if "=" in word]))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
