"""Names of joints without what their makers put around them: an asset's name, Japanese words, letters of full width."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from functools import lru_cache

#: Japanese words of joints, as MikuMikuDance's models have them, and what other rigs say.
JAPANESE_WORDS = {
    "センター": "Center",
    "グルーブ": "Groove",
    "上半身": "Spine",
    "下半身": "Pelvis",
    "胴体": "Spine",
    "腰": "Waist",
    "背": "Back",
    "腹": "Belly",
    "胸": "Chest",
    "首": "Neck",
    "頭": "Head",
    "目": "Eye",
    "左": "Left",
    "右": "Right",
    "鎖骨": "Clavicle",
    "肩": "Shoulder",
    "上腕": "UpperArm",
    "前腕": "ForeArm",
    "腕": "Arm",
    "ひじ": "Elbow",
    "ヒジ": "Elbow",
    "肘": "Elbow",
    "手首": "Wrist",
    "手": "Hand",
    "親指": "Thumb",
    "人指": "IndexFinger",
    "人差指": "IndexFinger",
    "中指": "MiddleFinger",
    "薬指": "RingFinger",
    "小指": "LittleFinger",
    "指": "Finger",
    "尻": "Buttock",
    "股": "Hip",
    "太もも": "Thigh",
    "ふともも": "Thigh",
    "腿": "Thigh",
    "大腿": "Thigh",
    "ひざ": "Knee",
    "ヒザ": "Knee",
    "膝": "Knee",
    "すね": "Shin",
    "脛": "Shin",
    "足首": "Ankle",
    "足先": "Toe",
    "つま先": "Toe",
    "つまさき": "Toe",
    "爪先": "Toe",
    "かかと": "Heel",
    "踵": "Heel",
    "足": "Leg",
    "脚": "Leg",
    "捩り": "Twist",
    "捩": "Twist",
    "補助": "Helper",
}
#: A longer word may hold a shorter one: a wrist is a hand's neck.
_JAPANESE = re.compile("|".join(sorted(JAPANESE_WORDS, key=len, reverse=True)))

#: Share of the names that must begin alike for that to be an asset's name; sides, left and right, have half at most.
_SHARED = 0.6
_SEPARATORS = re.compile(r"[_:|.\s-]+")


def plain_name(name: str) -> str:
    """The name in usual letters, Japanese words in English: ``LeftKnee`` of the Japanese for it."""
    if name.isascii():
        return name
    english = _JAPANESE.sub(lambda match: JAPANESE_WORDS[match[0]], unicodedata.normalize("NFKC", name))
    return re.sub(r"(?<=[a-z])IK", "_ik_", english)


@lru_cache(maxsize=64)
def plain_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """:func:`plain_name` of each name of a skeleton, without the asset's name that most begin with (``Bob_LFoot``)."""
    plain = [plain_name(name) for name in names]
    prefix = _asset(plain)
    return tuple(name[len(prefix) :] if name.startswith(prefix) and name != prefix else name for name in plain)


def _asset(names: list[str]) -> str:
    """What most names begin with, up to a separator or to the capital that all go on with; may be empty."""
    counts: Counter[str] = Counter()
    for name in names:
        counts.update(name[: match.end()] for match in _SEPARATORS.finditer(name[:200]))
    shared = [prefix for prefix, count in counts.items() if count > _SHARED * len(names)]
    if shared:
        return max(shared, key=len)
    first, last = min(names), max(names)
    prefix = first[: next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))]
    while prefix and not all(name[len(prefix) : len(prefix) + 1].isupper() for name in names):
        prefix = prefix[:-1]
    return prefix if prefix[-1:].islower() or prefix[-1:].isdigit() else ""
