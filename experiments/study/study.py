"""Runs every job of tables 1 to 4 that is not done yet, one at a time; half-done ones go on where they stopped.

    python experiments/study/study.py data.folder=PATH/cmu_bvh60 [--hours 8] [--only 'posereg-*'] [--list]

Jobs are listed in study.yaml. A job is done when its raw result is there and was made under the same settings and
budget; a larger budget takes its run up again. Runs go to --runs (not committed), raw results to
experiments/TABLE/raw. After Ctrl-C, --hours or a kill, the same command goes on.
"""

from __future__ import annotations

import argparse
import fnmatch
import hashlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from egopose.checkpoint.resume import only_process
from egopose.core.errors import InputError
from egopose.core.safe_io import read_yaml

HERE = Path(__file__).resolve().parent
INTERRUPTED = 130


@dataclass(frozen=True)
class Job:
    """One row's figure: a run to train (several jobs may share one) and how it is judged.

    Args:
        table, method, protocol, fold, seed: which.
        run: name of its run directory.
        verb: ``train``, ``baseline`` or ``regressor``.
        task: ``estimation`` or ``forecasting``.
        overrides: of the run's configuration, budget included.
        store: name of its store, "" for the user's cache.
        evaluate: overrides of what it is judged on, the run's own where empty; ``evaluate_store`` its store.
        settings: overrides of conf/evaluate.yaml.
        survival: whether the mean action's survival from uniform starts of the training takes is judged too.
    """

    table: str
    method: str
    protocol: str
    fold: str
    seed: int
    run: str
    verb: str
    task: str
    overrides: tuple[str, ...]
    store: str
    evaluate: tuple[str, ...]
    evaluate_store: str
    settings: tuple[str, ...]
    survival: bool = False

    @property
    def name(self) -> str:
        return f"{self.method}-{self.protocol}-{self.fold}-seed{self.seed}"

    @property
    def fingerprint(self) -> str:
        """Changes with the settings and the budget, not with where things lie on a machine."""
        # What most jobs lack is left out, so that results from before it was thought of still count.
        about = {key: value for key, value in asdict(self).items() if key != "survival" or value}
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]

    def raw(self, results: Path) -> Path:
        """Where its result goes."""
        return results / self.table / "raw" / f"{self.name}.json"


def list_jobs(study: Mapping[str, Any]) -> list[Job]:
    """All jobs in the order of ``tables``.

    Raises:
        InputError: a row names a method or protocol that is not there, or two rows name the same job.
    """
    jobs: list[Job] = []
    for row in study["tables"]:
        for seed in row["seeds"]:
            for protocol in row["protocols"]:
                for fold in _named(study, "folds", protocol):
                    jobs += [_job(study, row, m, protocol, fold, seed) for m in row["methods"]]
    seen: set[str] = set()
    for job in jobs:
        if job.name in seen:
            raise InputError("study", "tables", f"{job.name} stands twice")
        seen.add(job.name)
    return jobs


def _job(study: Mapping[str, Any], row: Mapping[str, Any], method: str, protocol: str, fold: str, seed: int) -> Job:
    judged, trained_in = _named(study, "folds", protocol)[fold], protocol
    trained = judged
    if "of" in judged:
        trained_in = judged["of"]
        trained = _named(study, "folds", trained_in)[fold]
    what = _named(study, "methods", method)
    of = what.get("of", method)
    how = _named(study, "methods", of)
    own = [] if how["verb"] == "regressor" else [f"training.total_steps={row.get('budget', study['budget'])}"]
    seeds = [word.format(seed=seed) for word in study["seed"]] if how["verb"] != "regressor" else []
    overrides = [*study["data"], *trained["overrides"], *how.get("overrides", ()), *own, *seeds]
    return Job(
        row["table"],
        method,
        protocol,
        fold,
        seed,
        f"{of}-{trained_in}-{fold}-seed{seed}",
        how["verb"],
        how.get("task", "estimation"),
        tuple(overrides),
        trained.get("store", ""),
        tuple(judged.get("evaluate", ())),
        judged.get("store", "") if "of" in judged else "",
        tuple(what.get("settings", ())),
        bool(row.get("survival", False)),
    )


def _named(study: Mapping[str, Any], group: str, name: str) -> Any:
    if name not in study[group]:
        raise InputError("study", group, f"has no {name!r}; there are {', '.join(study[group])}")
    return study[group][name]


def is_done(job: Job, results: Path) -> bool:
    """Whether the raw result is there, whole, and of these settings."""
    try:
        return bool(json.loads(job.raw(results).read_text())["fingerprint"] == job.fingerprint)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def run_study(
    jobs: Sequence[Job],
    results: Path,
    launch: Callable[[Job, float | None], int],
    seconds: float | None = None,
) -> list[str]:
    """Launch what is not done, in order; returns the names of jobs that failed.

    Args:
        jobs: see :func:`list_jobs`.
        results: where raw results are.
        launch: runs one job to its end or for so many seconds; its exit status: 0, 130 for interrupted, else failed.
        seconds: of the whole; None for no limit.

    Raises:
        SystemExit: 130, a job was interrupted or the time is up; the rest is left for the next time.
    """
    begun, failed = time.monotonic(), []
    for number, job in enumerate(jobs, 1):
        if is_done(job, results):
            continue
        left = None if seconds is None else seconds - (time.monotonic() - begun)
        if left is not None and left <= 0:
            raise SystemExit(INTERRUPTED)
        print(f"[{number}/{len(jobs)}] {job.table} {job.name}", flush=True)
        status = launch(job, left)
        if status == INTERRUPTED:
            raise SystemExit(INTERRUPTED)
        if status != 0 or not is_done(job, results):
            failed.append(job.name)
            print(f"failed ({status}): {job.name}", file=sys.stderr, flush=True)
    return failed


def launch_process(arguments: Sequence[str], runs: Path) -> Callable[[Job, float | None], int]:
    """Each job in a process of its own, its output in ``RUNS/JOB.log``: what it leaves in memory ends with it."""

    def launch(job: Job, seconds: float | None) -> int:
        runs.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, str(Path(__file__).resolve()), "--job", job.name, *arguments]
        with (runs / f"{job.name}.log").open("a") as log:
            child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
            try:
                return child.wait(seconds)
            except (subprocess.TimeoutExpired, KeyboardInterrupt):
                # Ctrl-C reached the child as well, and a second would stop it at once; it saves and ends.
                if child.poll() is None and sys.exc_info()[0] is subprocess.TimeoutExpired:
                    child.send_signal(signal.SIGTERM)
                child.wait()
                return INTERRUPTED

    return launch


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "overrides", nargs="*", help="of every job, for what differs between machines: data.folder=PATH"
    )
    parser.add_argument("--study", type=Path, default=HERE / "study.yaml")
    parser.add_argument("--runs", type=Path, default=Path("runs/study"))
    parser.add_argument("--results", type=Path, default=HERE.parent)
    parser.add_argument("--hours", type=float)
    parser.add_argument("--only", default="*", help="jobs whose name matches")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    given = parser.parse_args()
    runs, results = given.runs.resolve(), given.results.resolve()
    try:
        jobs = list_jobs(read_yaml(given.study, "study"))
        if given.list:
            for job in jobs:
                print(f"{'done' if is_done(job, results) else 'open'}  {job.table}  {job.name}")
            return
        if given.job:
            from jobs import run_job

            run_job(next(job for job in jobs if job.name == given.job), runs, results, given.overrides)
            return
        jobs = [job for job in jobs if fnmatch.fnmatch(job.name, given.only)]
        passed = ["--study", str(given.study), "--runs", str(runs), "--results", str(results), *given.overrides]
        with only_process(runs):
            seconds = None if given.hours is None else given.hours * 3600
            failed = run_study(jobs, results, launch_process(passed, runs), seconds)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"{len(jobs) - len(failed)} of {len(jobs)} jobs done", flush=True)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}; see {runs}/JOB.log")


if __name__ == "__main__":
    main()
