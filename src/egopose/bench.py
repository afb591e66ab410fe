"""``python -m egopose.bench VERB [--json] [--rounds N] [key=value ...]``: measure the program's own parts.

env: the speed of the collection loop beside MuJoCo's own.
train: the speed of whole iterations of training beside MuJoCo's own.
features: from an MP4 to visual features beside decoding alone.
rates: tracking, energy and speed of coarser physics.
scaling: the cost of every part of an iteration, and the memory of workers that share the data.
sync: the accuracy of offsets between motions and videos.
stream: live estimation: frames a second, latency by stage, late frames, memory.
plan: the planner at test time beside its bare physics.
estimate: the command `egopose estimate` on a film, beside the film's own length.
resume: a training killed at random moments beside the same one left alone.
retarget: frames a second of retargeting to the humanoid, on one core.
export: what every export format loses, by independent readers.
scenes: a third person's reconstruction against true motions among boxes, by cameras.
film: estimates from rendered films against the true motion, by cameras; whether bad films are told.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib import import_module

from egopose.benchmarks.words import as_settings
from egopose.core.errors import InputError
from egopose.core.result_files import finite_or_null
from egopose.core.verbs import BENCHMARKS


def command_line() -> argparse.ArgumentParser:
    """What may stand in the command."""
    parser = argparse.ArgumentParser(
        prog="egopose bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=list(BENCHMARKS))
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="settings; --key a b says key=a,b")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--rounds", type=int, help="how often: rounds, or kills (resume), or lengths (stream)")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = command_line().parse_intermixed_args(as_settings(sys.argv[1:] if arguments is None else arguments))
    verb = import_module(f"egopose.benchmarks.{options.verb}")
    try:
        result = verb.run(options.overrides, BENCHMARKS[options.verb] if options.rounds is None else options.rounds)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if options.json:
        print(json.dumps(finite_or_null(result), allow_nan=False))
        return
    if hasattr(verb, "tables"):
        print(verb.tables(result))
        return
    for name, value in result.items():
        print(f"{name:22s} {value:.3f}" if isinstance(value, float) else f"{name:22s} {value}")


if __name__ == "__main__":
    main()
