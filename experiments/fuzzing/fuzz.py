"""Coverage-guided fuzzing of every reader: ``python experiments/fuzzing/fuzz.py`` (pip install 'egopose[fuzz]').

Atheris (libFuzzer) keeps the inputs that reach new edges of the readers' Python code and changes them further. An input
is a finding when it raises anything but InputError, breaks what the reader promises, takes more than a second of
processor time or, by libFuzzer's own limits, over 2 GB or ten seconds. Each reader runs in a process of its own;
findings are kept under ``findings/`` and the counts go into ``results.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from egopose.core.errors import InputError

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
import readers  # noqa: E402

SHARES = {
    **{"bvh": 0.15, "acclaim": 0.1, "deepmimic": 0.1, "native": 0.1, "amass": 0.1},
    **{"mvnx": 0.05, "trc": 0.05, "c3d": 0.05, "tensors": 0.1, "store": 0.05, "config": 0.1, "video": 0.05},
}
SLOW_SECONDS, HANG_SECONDS, MEMORY_MB = 1.0, 10, 2048


def child(name: str, runs: int, seed: int, work: Path) -> None:
    """Fuzz one reader; does not return."""
    import atheris

    reader = readers.READERS[name]
    (HERE / "findings").mkdir(exist_ok=True)
    with atheris.instrument_imports(include=list(reader.instrument)):
        corpus = work / "corpus"
        corpus.mkdir()
        for number, content in enumerate(reader.seeds()):
            (corpus / f"seed{number}").write_bytes(content)
            reader_path = work / f"m{reader.suffix}"
            reader_path.write_bytes(content)
            _quietly(reader.read, reader_path)

    path = work / f"m{reader.suffix}"
    counts = {"inputs": 0, "refused": 0, "read": 0, "slowest_s": 0.0}
    findings: dict[str, dict[str, Any]] = {}
    read = reader.seeds()

    def one(data: bytes) -> None:
        path.write_bytes(data)
        start, result = time.process_time(), None
        try:
            reader.read(path)
            counts["read"] += 1
            read[counts["read"] % 256 : counts["read"] % 256 + 1] = [data]
        except InputError as error:
            counts["refused"] += 1
            if len(str(error)) > 400 or "\n" in str(error):
                result = ("message", f"not one short line: {str(error)[:100]!r}")
        except BaseException as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            result = (f"{type(error).__name__} {Path(place.filename).name}:{place.lineno}", str(error)[:200])
        seconds = time.process_time() - start
        counts["inputs"] += 1
        counts["slowest_s"] = max(counts["slowest_s"], seconds)
        if result is None and seconds > SLOW_SECONDS:
            result = ("slow", f"{seconds:.1f} s")
        if result is not None and result[0] not in findings:
            digest = hashlib.sha256(data).hexdigest()[:12]
            (HERE / "findings" / f"{name}-{digest}{reader.suffix}").write_bytes(data)
            findings[result[0]] = {"what": result[1], "file": f"{name}-{digest}{reader.suffix}"}
        if counts["inputs"] % 100 == 0 or result is not None:
            (work / "counts.json").write_text(json.dumps({**counts, "findings": findings}))

    def mutator(data: bytes, limit: int, number: int) -> bytes:
        # Most changes break an input for good; half of them start from one that could be read, so that some go deeper.
        if number % 2:
            data = read[number // 2 % len(read)]
        blind = lambda raw: atheris.Mutate(raw, max(len(raw), 16) * 2)  # noqa: E731
        return readers.mutate(data, number, blind, reader.binary)[:limit]

    largest = max((p.stat().st_size for p in corpus.iterdir()), default=1024)
    flags = [
        f"-runs={runs}",
        f"-seed={seed}",
        f"-max_len={max(4096, 2 * largest)}",
        "-len_control=0",
        "-mutate_depth=1",
    ]
    flags += [f"-timeout={HANG_SECONDS}", f"-rss_limit_mb={MEMORY_MB}", f"-artifact_prefix={HERE}/findings/{name}-"]
    atheris.Setup([sys.argv[0], *flags, str(corpus)], one, custom_mutator=mutator)
    atheris.Fuzz()


def _quietly(read: Any, path: Path) -> None:
    """Read once so that everything is imported while imports are instrumented."""
    try:
        read(path)
    except InputError as error:
        print(f"seed refused: {error}", file=sys.stderr)


def run(name: str, runs: int, seed: int) -> dict[str, Any]:
    """Fuzz one reader in a child process; what it counted."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        command = [sys.executable, str(HERE / "fuzz.py"), "--child", name, "--runs", str(runs), "--seed", str(seed)]
        environment = {**os.environ, "FUZZ_FOLDER": folder, "OMP_NUM_THREADS": "1", "OPENCV_LOG_LEVEL": "OFF"}
        environment |= {"OPENCV_FFMPEG_LOGLEVEL": "-8", "PYTHONDONTWRITEBYTECODE": "1"}
        start = time.perf_counter()
        done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", check=False)
        seconds = time.perf_counter() - start
        path = Path(folder) / "counts.json"
        counts = json.loads(path.read_text()) if path.is_file() else {"inputs": 0, "findings": {}}
    last = re.findall(r"#(\d+)\s+(\S+)\s+cov: (\d+) ft: (\d+) corp: (\d+)/\S+.*?rss: (\d+)Mb", done.stderr)
    first = last[0] if last else ("0", "", "0", "0", "0", "0")
    end = last[-1] if last else first
    out = {"inputs": int(end[0]), **{k: v for k, v in counts.items() if k not in ("inputs", "findings")}}
    out |= {"edges_of_seeds": int(first[2]), "edges": int(end[2]), "features": int(end[3]), "corpus": int(end[4])}
    out |= {"peak_rss_mb": int(end[5]), "seconds": round(seconds, 1), "findings": counts["findings"]}
    if done.returncode != 0:  # libFuzzer stopped: a hang, too much memory, a crash of the interpreter
        out["stopped"] = " ".join(done.stderr[-1500:].split())[-600:]
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=220_000, help="inputs in sum over the readers")
    parser.add_argument("--seed", type=int, default=1, help="of libFuzzer and the mutators")
    parser.add_argument("--only", nargs="*", choices=sorted(SHARES), help="these readers alone")
    parser.add_argument("--output", type=Path, default=HERE / "results.json")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.child, options.runs, options.seed, Path(os.environ["FUZZ_FOLDER"]))
        return
    names = options.only or list(SHARES)
    total = sum(SHARES[name] for name in names)
    results: dict[str, Any] = {}
    for name in names:
        results[name] = run(name, int(options.runs * SHARES[name] / total), options.seed)
        print(f"{name}: {json.dumps(results[name])}", flush=True)
    summary = {
        "inputs": sum(r["inputs"] for r in results.values()),
        "findings": sum(len(r["findings"]) + ("stopped" in r) for r in results.values()),
        "seconds": round(sum(r["seconds"] for r in results.values()), 1),
        "seed": options.seed,
        "readers": results,
    }
    options.output.write_text(json.dumps(summary, indent=1) + "\n")
    print(f"{summary['inputs']} inputs, {summary['findings']} findings, {summary['seconds']} s")
    raise SystemExit(1 if summary["findings"] else 0)


if __name__ == "__main__":
    main()
