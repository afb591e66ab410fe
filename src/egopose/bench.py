"""``python -m egopose.bench env [--json] [key=value ...]``: measure the environment beside MuJoCo's own speed."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import argparse  # noqa: E402
import json  # noqa: E402
import sys  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from typing import Any  # noqa: E402

from egopose.errors import InputError  # noqa: E402

_STEPS_A_ROUND = 32  # control steps of every world: with 64 worlds about two seconds of physics at 450 Hz


def bench_env(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """The full collection loop beside raw ``mj_step`` of the same model, substeps, threads and states.

    The loop is training's own: policy network, physics, observation, reward, termination, resets, visual context,
    normaliser and TorchRL's collector, on the default clips. The context is noise: its values cost nothing.

    Args:
        overrides: of the training configuration (``sim=fast collector.worlds=32``).
        rounds: interleaved; the median counts.

    Returns:
        See :func:`egopose.envs.benchmark.compare_with_raw`.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    from egopose import pipeline
    from egopose.envs.benchmark import compare_with_raw
    from egopose.training.collectors import CollectorSettings, base_env, build_collector, set_threads

    config = pipeline.compose_config("train", ["sim=paper", *overrides])
    material = pipeline.motion_material(config)
    settings = CollectorSettings.from_config(config["collector"])
    set_threads(settings.threads)
    env = pipeline.build_env(config, material, worlds=settings.worlds, threads=settings.physics_threads)
    actor, _ = pipeline.build_networks(config, material, env)
    collector = build_collector(settings, lambda _: env, actor, settings.worlds * _STEPS_A_ROUND)
    try:
        return compare_with_raw(iter(collector), base_env(env).physics, rounds)
    finally:
        collector.shutdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="egopose.bench", description=__doc__)
    parser.add_argument("verb", choices=["env"])
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="of the training configuration")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--rounds", type=int, default=9, help="interleaved rounds; the median counts")
    options = parser.parse_intermixed_args(arguments)
    try:
        result = bench_env(options.overrides, options.rounds)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if options.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:22s} {value:.3f}" if isinstance(value, float) else f"{name:22s} {value}")


if __name__ == "__main__":
    main()
