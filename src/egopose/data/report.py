"""What is in a store, for people."""

from __future__ import annotations

from egopose.data.store import TakeInfo, TakeStore


def store_report(store: TakeStore) -> str:
    """A table of the takes: length, retargeting error, share of frames on the floor, the video's origin; then notes."""
    lines = [f"{'take':<34}{'subject':>9}{'frames':>8}{'seconds':>9}{'retarget mm':>13}{'on floor':>10}  video"]
    for take in store.takes:
        feasible = sum(b - a for a, b in take.supported) / take.length
        lines.append(
            f"{take.name:<34}{take.subject:>9}{take.length:>8}{take.length / store.fps:>9.1f}"
            f"{take.retargeting_mm:>13.1f}{feasible:>10.0%}  {_video(take)}"
        )
    lines += [f"{take.name}: {note}" for take in store.takes for note in take.notes]
    lines += [f"warning: {take.name}: {line}" for take in store.takes for line in take.warnings]
    total = store.frames_total
    lines.append(f"{len(store.takes)} takes, {total} frames, {total / store.fps / 60:.1f} min: {store.root}")
    return "\n".join(lines)


def _video(take: TakeInfo) -> str:
    return "rendered" if take.rendered else f"{take.video} at {take.sync_offset:+.3f} s"
