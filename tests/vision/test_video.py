"""MP4 writing, decoding, resampling in time, and what is said of files that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision import video
from egopose.vision.video import iter_frames, probe_video, read_frames, write_video

SIZE = 32
BITS = 8


def counting_frames(count: int) -> list[np.ndarray]:
    """Pictures whose vertical bars are the index in binary: that survives any compression."""
    bits = (np.arange(count)[:, None] >> np.arange(BITS)) & 1
    rows = np.repeat(bits, SIZE // BITS, axis=1).astype(np.uint8) * 255
    return [np.broadcast_to(row[None, :, None], (SIZE, SIZE, 3)).copy() for row in rows]


def index_of(frame: np.ndarray) -> int:
    bars = frame.reshape(SIZE, BITS, SIZE // BITS, 3).mean((0, 2, 3)) > 128
    return int(bars @ (1 << np.arange(BITS)))


@pytest.fixture(scope="module")
def counting(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Videos of two seconds at several rates whose bars say the frame's index."""
    folder = tmp_path_factory.mktemp("video")
    paths = {}
    for fps in (24, 25, 30):
        paths[fps] = folder / f"{fps}.mp4"
        write_video(paths[fps], counting_frames(2 * fps), fps)
    return paths


def test_frames_come_back_in_order_with_their_times(counting: dict[int, Path]) -> None:
    decoded = list(read_frames(counting[25]))
    assert [index_of(f) for _, f in decoded] == list(range(50))
    np.testing.assert_allclose([t for t, _ in decoded], np.arange(50) / 25, atol=1e-3)
    assert probe_video(counting[25]).fps == pytest.approx(25)
    assert decoded[0][1].shape == (SIZE, SIZE, 3)
    assert decoded[0][1].dtype == np.uint8


def test_colours_keep_their_channel(tmp_path: Path) -> None:
    red = np.zeros((64, 64, 3), np.uint8)
    red[..., 0] = 200
    write_video(tmp_path / "red.mp4", [red] * 3, 30)
    _, frame = next(iter(read_frames(tmp_path / "red.mp4")))
    assert frame[..., 0].mean() > 180
    assert frame[..., 1:].mean() < 30


@settings(max_examples=25, deadline=None)
@given(
    source=st.sampled_from([24, 25, 30]),
    target=st.sampled_from([10.0, 24.0, 30.0, 60.0]),
    offset=st.floats(0, 1.5),
)
def test_resampling_takes_the_nearest_frame(
    counting: dict[int, Path], source: int, target: float, offset: float
) -> None:
    frames = list(iter_frames(counting[source], target, offset))
    times = np.arange(len(frames)) / target + offset
    got = np.array([index_of(f) for f in frames])
    # Within half a frame, and a millisecond for the container's time stamps.
    assert np.all(np.abs(got / source - times) <= 0.5 / source + 2e-3)
    assert times[-1] <= 2.0 + 1e-3 < times[-1] + 1 / target + 1 / source


def test_count_gives_exactly_the_motions_frames(counting: dict[int, Path]) -> None:
    assert [index_of(f) for f in iter_frames(counting[30], 30, 0.5, 20)] == list(range(15, 35))


def test_a_motion_outside_the_video_is_refused(counting: dict[int, Path]) -> None:
    with pytest.raises(InputError, match=r"ends 1\.\d+ s before the motion"):
        list(iter_frames(counting[30], 30, 0, 90))
    with pytest.raises(InputError, match=r"starts 0\.500 s before the video"):
        list(iter_frames(counting[30], 30, -0.5))
    with pytest.raises(InputError, match="behind the video's end"):
        list(iter_frames(counting[30], 30, 10))


@pytest.mark.parametrize("content", [b"", b"no video at all" * 50])
def test_a_file_that_is_no_video_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.mp4"):
        list(read_frames(path))


def test_a_missing_and_a_truncated_file_are_refused(tmp_path: Path, counting: dict[int, Path]) -> None:
    with pytest.raises(InputError, match="no such file"):
        list(read_frames(tmp_path / "none.mp4"))
    # mp4v writes its index at the end: half of the file has none.
    whole = counting[30].read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        list(read_frames(tmp_path / "half.mp4"))


def test_an_absurd_size_is_refused_before_decoding(counting: dict[int, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MAX_SIDE", SIZE - 1)
    with pytest.raises(InputError, match=r"size: 32 x 32"):
        list(read_frames(counting[30]))


def test_a_video_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "take.mp4"

    def interrupted() -> Iterator[np.ndarray]:
        yield counting_frames(1)[0]
        raise KeyError

    with pytest.raises(KeyError):
        write_video(path, interrupted(), 30)
    assert not path.exists()
    assert list(path.parent.iterdir()) == []
    with pytest.raises(InputError, match="no frames"):
        write_video(path, [], 30)


def test_frames_of_the_wrong_kind_are_refused(tmp_path: Path) -> None:
    for wrong in (np.zeros((8, 8, 3)), np.zeros((8, 8), np.uint8), np.zeros((8, 8, 4), np.uint8)):
        with pytest.raises(InputError, match="uint8"):
            write_video(tmp_path / "x.mp4", [wrong], 30)
    with pytest.raises(InputError, match="differs"):
        write_video(tmp_path / "x.mp4", [np.zeros((32, 32, 3), np.uint8), np.zeros((32, 64, 3), np.uint8)], 30)
