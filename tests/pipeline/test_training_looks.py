"""The looks that training takes at its policy begin at the same frames, whatever fell before."""

from __future__ import annotations

from pathlib import Path

from helpers.tracking_run import configuration, tracking_dataset

from egopose.pipeline.run import build_evaluation, build_run


def test_a_look_is_not_harder_for_what_fell_in_the_one_before(tmp_path: Path) -> None:
    config = configuration()
    config["task"]["starts"] = {"kind": "adaptive", "bin": 1, "unit": 1.0, "rate": 1.0, "floor": 0.01}
    config["training"]["evaluation_num_envs"] = 16
    dataset = tracking_dataset(config)
    run = build_run(config, tmp_path, dataset)
    evaluate = build_evaluation(run, dataset)
    looks = [evaluate(number) for number in range(4)]
    run.collector.shutdown()
    assert all(look == looks[0] for look in looks)
