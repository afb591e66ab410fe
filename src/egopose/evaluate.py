"""``python -m egopose.evaluate checkpoint=RUN_OR_CHECKPOINT [split=test] [out=DIR]``: score a policy beside PoseReg."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError

if TYPE_CHECKING:
    pass
from egopose.evaluation.estimation_run import run_evaluation, summary
from egopose.evaluation.options import data_at, output_folder, physics_group


@command("evaluate")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.evaluation.take_videos import take_videos
    from egopose.pipeline.agent import load_agent
    from egopose.vision.corruption import Corruption

    try:
        values = resolved(config)
        given = values["checkpoint"]
        paths = [str(p) for p in given] if isinstance(given, list) else [str(given)]
        overrides = physics_group(values["physics"]) or {}
        overrides |= {"corruption": values["corruption"]} if "corruption" in values else {}
        which, data = str(values["which"]), values["data_folder"]
        agents = [load_agent(path, which=which, overrides=overrides | data_at(data, path, which)) for path in paths]
        names, videos = take_videos(agents[0].config)
        spoilt = Corruption.from_config(values) is not None
        part = f"{values['split']}-corrupted" if spoilt else str(values["split"])
        out = output_folder(values["out"], agents[0].path, part)
        if agents[0].config["task"]["name"] == "forecasting":
            from egopose.evaluation.forecast_run import run_forecast_evaluation

            print(run_forecast_evaluation(values, agents, names, videos, out), flush=True)
        else:
            print(summary(run_evaluation(values, agents, names, videos, out)), flush=True)
        if values["report"]:
            from egopose.evaluation.reports import evaluation_report

            print(f"report: {evaluation_report(out, agents[0].material.humanoid)}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
