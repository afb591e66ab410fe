"""Which joint of a foreign skeleton plays which part of a human body.

Only four words have to be recognised in the names (foot or ankle, hand or wrist, head or neck, and a side); the rest
follows from the tree: knees and elbows are found by :mod:`egopose.motion.limbs`, the chest is where the arms meet, the
hips are where the legs do.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.joint_names import plain_name, plain_names
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.limbs import HELPER, limb_joints
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

SIDES = ("right", "left")
_LIMB_PARTS = ("thigh", "shin", "foot", "toe", "clavicle", "arm", "forearm", "hand")
_PARTS = ("hips", "neck", "head", *(f"{side}_{part}" for side in SIDES for part in _LIMB_PARTS))

_LIMB_WORDS = (
    "foot|ankle|hand|wrist|hip|femur|tibia|toe|clavicle|humerus|radius|knee|elbow|shoulder|collar|thigh|shin|arm|leg"
    "|palm|finger|thumb|ball|heel|calf"
)


#: The first that fits tells the side. A letter alone counts beside a separator, before or behind a limb's word, or as
#: a capital of its own in a name of small and capital letters.
_SIDE_PATTERNS = (
    (r"(left|right)", re.IGNORECASE),
    (r"(?:^|[_.\s()\[\]-])([lr])\d*(?:[_.\s()\[\]-]|$)", re.IGNORECASE),
    (rf"(?:^|[_.\s-])([lr])(?:{_LIMB_WORDS})", re.IGNORECASE),
    (rf"(?:{_LIMB_WORDS})\d*([lr])(?![a-z])", re.IGNORECASE),
    (r"[a-z0-9]([LR])(?=$|[_.\s\d-]|[A-Z][a-z])", 0),
)


@dataclass(frozen=True)
class BodyMap:
    """Source joint index for each part of the body.

    Args:
        parts: part name -> joint index. Parts: ``hips``, ``neck``, ``head`` and for either side ``thigh shin foot
            clavicle arm forearm hand`` as ``right_thigh``; ``right_toe`` where there is one.
        spine: joint indices from the first spine joint to the chest (the parent of neck and arms), at least one.
        unmapped: names of the source joints that play no part.
        frames: thigh and arm -> the last joint of that bone where it is made of several: the knee's axis stands still
            in its frame.
    """

    parts: dict[str, int]
    spine: tuple[int, ...]
    unmapped: tuple[str, ...]
    frames: dict[str, int] = field(default_factory=dict)

    def frame(self, part: str) -> int:
        """The joint whose orientation is the part's."""
        return self.frames.get(part, self.parts[part])


def side_of(name: str) -> str | None:
    """``"left"``, ``"right"`` or None from a joint's name in any common convention.

    ``LeftFoot L_Foot lfoot Foot_L foot.l.001 FootL Bob_LFoot``, and the Japanese words.
    """
    stripped = re.sub(r"^(cc_base_|mixamorig:?|bip\d*_?|b_|joint_|.*[:|])", "", plain_name(name), flags=re.IGNORECASE)
    for pattern, flags in _SIDE_PATTERNS:
        if match := re.search(pattern, stripped, flags):
            return "left" if match[1].lower().startswith("l") else "right"
    return None


def identify(skeleton: Skeleton, overrides: dict[str, str] | None = None, positions: Array | None = None) -> BodyMap:
    """Find the parts of a humanoid skeleton.

    Args:
        skeleton: any humanoid tree.
        overrides: part -> joint name, for rigs whose names say too little.
        positions: ``[T, J, 3]`` m, the joints in some frames of a clip: a limb of many bones is told by how it bends.
            Default: the rest pose.

    Raises:
        InputError: a part cannot be found, or two parts would share a joint; names the part and the joints there are.
    """
    overrides = overrides or {}
    for part, name in overrides.items():
        if part not in _PARTS:
            raise InputError(
                skeleton.name or "skeleton", f"mapping.{part}", f"is no part; there are {', '.join(_PARTS)}"
            )
        if name not in skeleton.names:
            raise InputError(skeleton.name or "skeleton", f"mapping.{part}", f"there is no joint {name!r}")
    parts: dict[str, int] = {part: skeleton.index(name) for part, name in overrides.items()}
    if positions is None:
        positions = forward_kinematics(skeleton, skeleton.rest_qpos()[None])[0]
    frames: dict[str, int] = {}
    for roles, words in (
        (("thigh", "shin", "foot"), ("ankle", "foot")),
        (("arm", "forearm", "hand"), ("wrist", "hand")),
    ):
        for side in SIDES:
            if f"{side}_{roles[-1]}" not in parts:
                parts[f"{side}_{roles[-1]}"] = _find(skeleton, words, side, f"{side}_{roles[-1]}")
        trunk = _common(skeleton, *(parts[f"{side}_{roles[-1]}"] for side in SIDES))
        for side in SIDES:
            _limb(skeleton, parts, side, roles, trunk, positions)
            upper, lower = (f"{side}_{role}" for role in roles[:2])
            if parts[upper] in _path(skeleton, parts[lower])[:-2]:
                frames[upper] = int(skeleton.parents[parts[lower]])
    if "head" not in parts:
        parts["head"] = _find(skeleton, ("head", "neck"), None, "head")
    hips = parts.setdefault("hips", _common(skeleton, parts["left_thigh"], parts["right_thigh"]))
    chest = _common(skeleton, parts["left_arm"], parts["right_arm"])
    for side in SIDES:
        chain = _between(skeleton, chest, parts[f"{side}_arm"])
        if chain and f"{side}_clavicle" not in parts:
            parts[f"{side}_clavicle"] = chain[-1]
        if f"{side}_toe" not in parts:
            toe = _toe(skeleton, parts[f"{side}_foot"])
            if toe is not None:
                parts[f"{side}_toe"] = toe
    neck = _between(skeleton, chest, parts["head"])
    if neck and "neck" not in parts:
        parts["neck"] = neck[0]
    path = _path(skeleton, chest)
    trunk = _common(skeleton, hips, chest)
    spine = tuple(i for i in path[path.index(trunk) + 1 :] if i not in parts.values()) or (chest,)
    used = set(parts.values()) | set(spine) | set(frames.values())
    if len(set(parts.values())) != len(parts):
        raise InputError(
            skeleton.name or "skeleton", "mapping", f"one joint would play two parts: {_named(skeleton, parts)}"
        )
    unmapped = tuple(n for i, n in enumerate(skeleton.names) if i not in used)
    return BodyMap(parts, spine, unmapped, frames)


def sample(positions: Array, frames: int = 200) -> Array:
    """Up to ``frames`` of ``[T, ...]``, evenly over the clip."""
    return positions[np.unique(np.linspace(0, len(positions) - 1, frames).astype(int))]


def _limb(
    skeleton: Skeleton, parts: dict[str, int], side: str, roles: tuple[str, str, str], trunk: int, positions: Array
) -> None:
    """Add the limb's two upper parts to ``parts`` where an override has not."""
    upper, lower, end = (f"{side}_{role}" for role in roles)
    if upper in parts and lower in parts:
        return
    chain = _between(skeleton, trunk, parts[end])
    found = limb_joints(skeleton, chain, parts[end], positions, (parts.get(upper), parts.get(lower)))
    if found is None:
        raise InputError(
            skeleton.name or "skeleton",
            f"mapping.{upper if lower in parts else lower}",
            f"the {side} limb has too few joints",
        )
    parts.setdefault(upper, found[0])
    parts.setdefault(lower, found[1])


def _find(skeleton: Skeleton, words: tuple[str, ...], side: str | None, part: str) -> int:
    """The first joint (nearest the root) that carries one of ``words`` (in order of preference) and the side."""
    for word in words:
        hits = [
            i
            for i, name in enumerate(plain_names(skeleton.names))
            if re.search(word, name, re.IGNORECASE) and side_of(name) == side and not HELPER.search(name)
        ]
        if hits:
            return min(hits, key=lambda i: len(_path(skeleton, i)))
    raise InputError(
        skeleton.name or "skeleton",
        f"mapping.{part}",
        f"no joint is called {' or '.join(words)}{f' on the {side}' if side else ''}; give mapping.{part}=NAME out of: "
        + ", ".join(skeleton.names),
    )


def _toe(skeleton: Skeleton, foot: int) -> int | None:
    children = [i for i in skeleton.children(foot) if not HELPER.search(plain_names(skeleton.names)[i])]
    children = [i for i in children if np.linalg.norm(skeleton.offsets[i]) > 0.02]
    named = [i for i in children if re.search("toe|foot|ball", plain_names(skeleton.names)[i], re.IGNORECASE)]
    return (named or children or [None])[0]  # type: ignore[list-item]


def _path(skeleton: Skeleton, index: int) -> list[int]:
    path = [index]
    while (parent := int(skeleton.parents[path[-1]])) >= 0:
        path.append(parent)
    return path[::-1]


def _common(skeleton: Skeleton, a: int, b: int) -> int:
    common = [i for i, j in zip(_path(skeleton, a), _path(skeleton, b), strict=False) if i == j]
    return common[-1]


def _between(skeleton: Skeleton, top: int, bottom: int) -> list[int]:
    """Joints strictly between an ancestor and its descendant."""
    path = _path(skeleton, bottom)
    return path[path.index(top) + 1 : -1] if top in path else []


def _named(skeleton: Skeleton, parts: dict[str, int]) -> str:
    return ", ".join(f"{p}={skeleton.names[i]}" for p, i in sorted(parts.items()))
