"""``python -m egopose.report FOLDER [out=FILE] [key=value ...]``: one HTML page that holds everything it shows.

FOLDER is one of `egopose evaluate`, a sweep's (``hydra.sweep.dir``), or a reconstruction's. Further words are overrides
of conf/report.yaml. `egopose evaluate ... report=true` makes the same page of what it has just found.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.core.path_settings import Kind, checked_path
from egopose.core.safe_io import read_json
from egopose.evaluation.estimation_page import ReportSettings, write_report
from egopose.evaluation.forecast_page import write_forecast_page
from egopose.evaluation.reconstruction_page import ReconstructionPageSettings, write_reconstruction_page
from egopose.evaluation.sweep_report import SweepSettings, write_sweep_report
from egopose.humanoid.model import HumanoidModel
from egopose.inference.export import humanoid_for
from egopose.inference.reconstruction import PAGE, read_reconstruction, reconstruction_folder, simulated_humanoid

_SOURCE = "conf/report.yaml"


def evaluation_report(folder: Path, humanoid: HumanoidModel | None, overrides: Sequence[str] = ()) -> Path:
    """Write the page of an evaluation's folder, of estimates or of forecasts."""
    config = compose_config("report", overrides)
    settings = from_mapping(ReportSettings, config["evaluation"], f"{_SOURCE}: evaluation")
    results = read_json(folder / "results.json", "results")
    write = write_forecast_page if isinstance(results, dict) and "horizons_s" in results else write_report
    return write(folder, humanoid, settings, _out(config, folder))


def reconstruction_report(folder: Path, overrides: Sequence[str] = ()) -> Path:
    """Write the page of a reconstruction's folder.

    Raises:
        InputError: a file is missing or damaged, or the controls do not lead through the states.
    """
    config = compose_config("report", overrides)
    humanoid, out = simulated_humanoid(str(config["humanoid"])), _out(config, folder, PAGE)
    return rollout_report(folder, humanoid, _simulated(config), out, overrides)


def rollout_report(
    clip: Path, humanoid: HumanoidModel, simulated: Path | None, out: Path, overrides: Sequence[str] = ()
) -> Path:
    """Write the page of any simulated motion of a prepared clip to ``out``; None for the clip's own ``plan.npz``.

    Raises as :func:`reconstruction_report`.
    """
    values = compose_config("report", overrides)["reconstruction"]
    settings = from_mapping(ReconstructionPageSettings, values, f"{_SOURCE}: reconstruction")
    return write_reconstruction_page(read_reconstruction(clip, humanoid, simulated), settings, out)


def _simulated(config: Mapping[str, Any]) -> Path | None:
    given = config["simulated"]
    return None if given is None else Path(checked_path(given, Kind.FILE, "simulated"))


def run_report(folder: Path, overrides: Sequence[str] = ()) -> Path:
    """Write the page of whatever the folder is.

    Raises:
        InputError: it is no evaluation, sweep or reconstruction, or damaged; names it.
    """
    if not folder.is_dir():
        cause = (
            "is a file; give the folder of an evaluation, a sweep or a reconstruction"
            if folder.exists()
            else "no such folder"
        )
        raise InputError(folder, "path", cause)
    if reconstruction_folder(folder, _simulated(compose_config("report", overrides))) is not None:
        return reconstruction_report(folder, overrides)
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


def _out(config: Mapping[str, Any], folder: Path, name: str = "report.html") -> Path:
    out = folder / name if config["out"] is None else Path(checked_path(config["out"], Kind.NEW_FILE, "out"))
    if not out.parent.is_dir():
        raise InputError(out, "out", f"no folder {out.parent}")
    return out
