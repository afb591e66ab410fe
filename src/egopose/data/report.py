"""What is in a store, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from egopose.core.errors import InputError
from egopose.data.splits import split_takes
from egopose.data.store import PARTS, TakeInfo, TakeStore


def store_report(store: TakeStore, split: Mapping[str, Any] | None = None) -> str:
    """A table of the takes, notes and warnings, what was left out and why, and minutes by person.

    Args:
        store: of a set.
        split: ``conf/data``'s ``split``, for what each person trains and tests; None for neither.
    """
    wide = max([9, *(len(take.subject) + 2 for take in store.takes)])
    lines = [f"{'take':<34}{'subject':>{wide}}{'frames':>8}{'seconds':>9}{'retarget mm':>13}{'on floor':>10}  video"]
    for take in store.takes:
        feasible = sum(b - a for a, b in take.supported) / take.length
        lines.append(
            f"{take.name:<34}{take.subject:>{wide}}{take.length:>8}{take.length / store.fps:>9.1f}"
            f"{take.retargeting_mm:>13.1f}{feasible:>10.0%}  {_video(take)}"
        )
    lines += [f"{take.name}: {note}" for take in store.takes for note in take.notes]
    lines += [f"warning: {take.name}: {line}" for take in store.takes for line in take.warnings]
    lines += _left_out(store) + _gate(store)
    if split is not None and (split["kind"] != "time" or store.left_out):
        lines += _people(store, split)
    total = store.frames_total
    lines.append(f"{len(store.takes)} takes, {total} frames, {total / store.fps / 60:.1f} min: {store.root}")
    return "\n".join(lines)


def minutes_by_person(store: TakeStore, split: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Of each person ``takes``, ``prepared`` minutes, and minutes on the floor that ``train`` and ``test``."""
    rows: dict[str, dict[str, float]] = {}
    for take in store.takes:
        row = rows.setdefault(take.subject, {"takes": 0, "prepared": 0.0} | dict.fromkeys(PARTS, 0.0))
        row["takes"] += 1
        row["prepared"] += take.length / store.fps / 60
    for part in PARTS:
        try:
            fragments = split_takes(store.takes, split, part)
        except InputError:  # takes too short to test on; training says so where it matters
            continue
        for f in fragments:
            rows[store.takes[f.take].subject][part] += (f.stop - f.start) / store.fps / 60
    return rows


def _left_out(store: TakeStore) -> list[str]:
    """A line for every reason, and one for every clip that was refused."""
    reasons: dict[str, list[float | None]] = {}
    for clip in store.left_out:
        if not clip.refused:
            reasons.setdefault(clip.cause, []).append(clip.seconds)
    lines = [
        f"left out: {len(seconds)} clips{_minutes(seconds)}: {reason}" for reason, seconds in sorted(reasons.items())
    ]
    refused = [clip for clip in store.left_out if clip.refused]
    lines += [f"refused: {clip.name} ({clip.subject}){_minutes([clip.seconds])}: {clip.cause}" for clip in refused]
    if refused:
        lines.append(f"{len(refused)} clips refused{_minutes([clip.seconds for clip in refused])}")
    return lines


def _gate(store: TakeStore) -> list[str]:
    asked = [take for take in store.takes if take.gate is not None]
    if not asked:
        return []
    frames = sum(take.length for take in asked)
    share = sum(take.length * (take.feasible or 0.0) for take in asked) / frames
    lines = [f"physics gate: {take.name} ({take.subject}) fails: {take.gate}" for take in asked if take.gate]
    passed = len(asked) - len(lines)
    summary = f"physics gate: {passed} of {len(asked)} takes pass; contact can have made {share:.0%} of the frames"
    return [*lines, summary]


def _people(store: TakeStore, split: Mapping[str, Any]) -> list[str]:
    lines = [f"{'person':<24}{'takes':>7}{'minutes':>9}{'train':>8}{'test':>8}"]
    rows = minutes_by_person(store, split)
    for person, row in sorted(rows.items()):
        lines.append(_person(person, row))
    total = {key: sum(row[key] for row in rows.values()) for key in ("takes", "prepared", *PARTS)}
    return [*lines, _person(f"{len(rows)} people", total)]


def _person(name: str, row: Mapping[str, float]) -> str:
    return f"{name:<24}{row['takes']:>7.0f}{row['prepared']:>9.2f}{row['train']:>8.2f}{row['test']:>8.2f}"


def _minutes(seconds: list[float | None]) -> str:
    known = [value for value in seconds if value is not None]
    return f", {sum(known) / 60:.2f} min" if known else ""


def _video(take: TakeInfo) -> str:
    return "rendered" if take.rendered else f"{take.video} at {take.sync_offset:+.3f} s"
