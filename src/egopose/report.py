"""``python -m egopose.report FOLDER [out=FILE] [key=value ...]``: one HTML page that holds everything it shows.

FOLDER is one of `egopose evaluate`, or a sweep's (``hydra.sweep.dir``). Further words are overrides of
conf/report.yaml. `egopose evaluate ... report=true` makes the same page of what it has just found.
"""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import sys  # noqa: E402
from collections.abc import Mapping, Sequence  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from egopose.config import check_arguments, compose_config, from_mapping  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from egopose.humanoid.model import HumanoidModel

_SOURCE = "conf/report.yaml"


def evaluation_report(folder: Path, humanoid: HumanoidModel | None, overrides: Sequence[str] = ()) -> Path:
    """Write the page of an evaluation's folder: :func:`egopose.evaluation.html_report.write_report`'s, or of forecasts
    :func:`egopose.evaluation.forecast_page.write_forecast_page`'s."""
    from egopose.evaluation.forecast_page import write_forecast_page
    from egopose.evaluation.html_report import ReportSettings, write_report
    from egopose.untrusted import read_json

    config = compose_config("report", overrides)
    settings = from_mapping(ReportSettings, config["evaluation"], f"{_SOURCE}: evaluation")
    results = read_json(folder / "results.json", "results")
    write = write_forecast_page if isinstance(results, dict) and "horizons_s" in results else write_report
    return write(folder, humanoid, settings, _out(config, folder))


def run_report(folder: Path, overrides: Sequence[str] = ()) -> Path:
    """Write the page of whatever the folder is.

    Raises:
        InputError: it is neither an evaluation nor a sweep, or damaged; names it.
    """
    from egopose.evaluation.sweep_report import SweepSettings, write_sweep_report
    from egopose.export import humanoid_for

    if not folder.is_dir():
        cause = "is a file; give the folder of an evaluation or a sweep" if folder.exists() else "no such folder"
        raise InputError(folder, "path", cause)
    if (folder / "results.json").is_file():
        try:
            humanoid = humanoid_for(folder, "default")
        except InputError as error:
            print(f"no pictures: {error}", file=sys.stderr)
            humanoid = None
        return evaluation_report(folder, humanoid, overrides)
    config = compose_config("report", overrides)
    settings = from_mapping(SweepSettings, config["sweep"], f"{_SOURCE}: sweep")
    return write_sweep_report(folder, settings, _out(config, folder))


def _out(config: Mapping[str, Any], folder: Path) -> Path:
    out = folder / "report.html" if config["out"] is None else Path(str(config["out"]))
    if not out.parent.is_dir():
        raise InputError(out, "out", f"no folder {out.parent}")
    return out


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
        print(run_report(Path(folders[0]), [word for word in words if "=" in word]))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
