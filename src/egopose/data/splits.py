"""Which frames are trained on and which are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.data.store import PARTS, Fragment, TakeInfo

#: Settings under which every frame of every take trains.
WHOLE = {"kind": "time", "train_share": 1.0, "shortest": 1}


def split_takes(
    takes: Sequence[TakeInfo], settings: Mapping[str, Any], part: str, supported_only: bool = True
) -> list[Fragment]:
    """Fragments of the training or test part.

    Args:
        takes: of the store.
        settings: ``conf/data``'s ``split``: ``kind``: ``time`` (each take's first ``train_share`` trains, the rest
            tests, if it is at least ``shortest`` frames long; else the whole take trains) or ``subject`` (the takes of
            ``test_subjects`` test, all others train) or ``table`` (each take is for what its set's table says);
            ``subjects``: the only ones used, or null for all; ``shortest`` frames a fragment has.
        part: ``train`` or ``test``.
        supported_only: cut fragments where no body on a bare floor could be (see
            :func:`egopose.data.reference.supported`).

    Raises:
        InputError: an unknown setting, subject or kind, or nothing is left; names the field.
    """
    kind, subjects = settings["kind"], settings.get("subjects")
    shortest = convert(settings["shortest"], int, "data.split", "shortest")
    share = convert(settings.get("train_share"), float, "data.split", "train_share") if kind == "time" else 0.0
    if not 0.0 <= share <= 1.0:
        raise InputError("data.split", "train_share", f"must lie between 0 and 1, not {share}")
    if kind == "subject" and not settings.get("test_subjects"):
        raise InputError("data.split", "test_subjects", "is missing: say whose takes test, [1, 2]")
    known = {t.subject for t in takes}
    for key in ("subjects", "test_subjects"):
        if unknown := {str(s) for s in settings.get(key) or ()} - known:
            raise InputError(
                "data.split", key, f"no such subjects: {', '.join(sorted(unknown))}; there are {sorted(known)}"
            )
    out = []
    for index, take in enumerate(takes):
        if subjects is not None and take.subject not in {str(s) for s in subjects}:
            continue
        if kind == "time":
            cut = round(take.length * share)
            if take.length - cut < shortest:
                cut = take.length
            spans = {"train": (0, cut), "test": (cut, take.length)}
            start, stop = spans[part]
        elif kind == "subject":
            tests = take.subject in {str(s) for s in settings["test_subjects"]}
            start, stop = (0, take.length) if tests == (part == "test") else (0, 0)
        elif kind == "table":
            if take.part not in PARTS:
                cause = f"{take.name} has no part: data.columns.split names the table's column of train and test"
                raise InputError("data.split", "kind", cause)
            start, stop = (0, take.length) if take.part == part else (0, 0)
        else:
            raise InputError("data.split", "kind", f"must be time, subject or table, not {kind!r}")
        runs = take.supported if supported_only else ((0, take.length),)
        pieces = [(max(start, a), min(stop, b)) for a, b in runs]
        out += [Fragment(index, a, b) for a, b in pieces if b - a >= shortest]
    if not out:
        cause = f"leaves no fragment of {shortest} frames: give longer takes, or a smaller data.split.shortest"
        raise InputError("data.split", part, cause)
    return out
