"""MP4 writing, decoding of every container, resampling in time, and what is said of files that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision import pyav, video
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


def by_opencv(path: Path, code: str, fps: float = 25.0) -> Path:
    """The counting frames in another container."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, (SIZE, SIZE))
    assert writer.isOpened()
    for frame in counting_frames(20):
        writer.write(frame)
    writer.release()
    return path


def by_av1(path: Path, count: int = 20) -> Path:
    """An AV1 of the counting frames, by PyAV's own encoder."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libsvtav1", rate=25, options={"preset": "12", "svtav1-params": "lp=1"})
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for frame in counting_frames(count):
            large = np.repeat(np.repeat(frame, 2, axis=0), 2, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(large, format="rgb24")))
        container.mux(stream.encode(None))
    return path


CONTAINERS = [("avi", "MJPG"), ("avi", "XVID"), ("mkv", "mp4v"), ("mkv", "MJPG"), ("mov", "mp4v"), ("mp4", "mp4v")]


@pytest.mark.parametrize(("ending", "code"), CONTAINERS)
def test_other_containers_and_both_decoders(tmp_path: Path, ending: str, code: str) -> None:
    """Frames and times of AVI, Matroska and QuickTime; PyAV gives the same, to the bit."""
    path = by_opencv(tmp_path / f"v.{ending}", code)
    decoded = list(read_frames(path))
    assert [index_of(f) for _, f in decoded] == list(range(20))
    np.testing.assert_allclose([t for t, _ in decoded], np.arange(20) / 25, atol=2e-3)
    info = probe_video(path)
    assert (info.width, info.height, info.frames) == (SIZE, SIZE, 20)
    pytest.importorskip("av")
    with pyav.opened(path, video.look_into(path).kind) as stream:
        assert pyav.header(stream) == pytest.approx((SIZE, SIZE, 25.0, 20))
        other = list(pyav.frames(stream))
    first = other[0][0]
    assert first is not None
    np.testing.assert_allclose([t - first for t, _ in other], [t for t, _ in decoded], atol=1e-6)
    for (_, mine), (_, theirs) in zip(decoded, other, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize(("turn", "matrix"), [(90, (0, 1, -1, 0)), (180, (-1, 0, 0, -1)), (270, (0, -1, 1, 0))])
def test_a_telephone_held_upright(tmp_path: Path, turn: int, matrix: tuple[int, ...]) -> None:
    """The file's display matrix turns the picture, whoever decodes it."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:16, :32] = 200
    write_video(tmp_path / "v.mp4", [picture] * 3, 25)
    raw = bytearray((tmp_path / "v.mp4").read_bytes())
    at = raw.index(b"tkhd") + 44
    for place, value in zip((0, 4, 12, 16), matrix, strict=True):
        raw[at + place : at + place + 4] = (value * 65536).to_bytes(4, "big", signed=True)
    (tmp_path / "v.mp4").write_bytes(raw)
    _, frame = next(read_frames(tmp_path / "v.mp4"))
    expected = np.rot90(picture, -turn // 90)
    assert frame.shape == expected.shape
    assert np.abs(frame.astype(int) - expected).mean() < 10
    pytest.importorskip("av")
    with pyav.opened(tmp_path / "v.mp4", "MP4") as stream:
        _, other = next(pyav.frames(stream))
    np.testing.assert_array_equal(frame, other)


def test_av1_is_decoded(tmp_path: Path) -> None:
    decoded = list(read_frames(by_av1(tmp_path / "v.mp4")))
    assert [index_of(f[::2, ::2]) for _, f in decoded] == list(range(20))
    np.testing.assert_allclose([t for t, _ in decoded], np.arange(20) / 25, atol=2e-3)
    assert probe_video(tmp_path / "v.mp4").fps == pytest.approx(25)
    assert len(list(iter_frames(tmp_path / "v.mp4", 25, 0.2, 10))) == 10


def test_av1_is_called_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = by_av1(tmp_path / "v.mp4")
    monkeypatch.setattr(video, "_BEYOND_OPENCV", set())
    monkeypatch.setattr(pyav, "there", lambda: False)
    with pytest.raises(
        InputError, match=r"AV1 \(av01\) is a codec .* pip install 'egopose\[video\]'.* ffmpeg -i v\.mp4"
    ):
        list(read_frames(path))
    monkeypatch.undo()
    # The pictures overwritten: no decoder's lack, and no other exception.
    raw = bytearray(path.read_bytes())
    at = raw.index(b"mdat") + 4
    raw[at : at + 400] = bytes(400)
    path.write_bytes(raw)
    monkeypatch.setattr(video, "_BEYOND_OPENCV", set())
    with pytest.raises(InputError, match=r"decodes a frame of AV1 \(av01\): damaged"):
        list(read_frames(path))


def test_a_shared_av1_with_sound(shared: Path) -> None:
    pytest.importorskip("av")
    decoded = list(read_frames(shared / "cases" / "v_av1.mp4"))
    assert len(decoded) == 40
    np.testing.assert_allclose([t for t, _ in decoded], np.arange(40) / 30, atol=2e-3)
    assert decoded[0][1].shape == (128, 128, 3)


def test_what_is_wrong_with_an_mp4_is_said(tmp_path: Path, counting: dict[int, Path]) -> None:
    raw, path = counting[30].read_bytes(), tmp_path / "bad.mp4"
    index = raw.index(b"moov") - 4
    cases = {
        r"damaged: the index \(box moov\).* is missing; cut short: the box mdat should reach to byte": raw[
            : index // 2
        ],
        r"damaged: the index \(box moov\).* is missing; the recording was not finished": raw[:index],
        r"no video track in this MP4; its tracks: sound": raw.replace(b"vide", b"soun"),
        r"no video track in this MP4; its tracks: none": raw[: index + 16] + bytes(len(raw) - index - 16),
        r"damaged: no frame of this MP4 can be decoded \(MPEG-4 \(mp4v\)\)": raw[:48] + bytes(index - 48) + raw[index:],
        r"XQ99: a codec that PyAV does not decode either|XQ99 is a codec that this build": raw.replace(
            b"mp4v", b"XQ99"
        ).replace(b"esds", b"free"),
    }
    for expected, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=expected):
            list(read_frames(path))
    # The index before the pictures, the end cut off: what is there is read.
    moved = by_fast_start(raw, index)
    path.write_bytes(moved[: len(moved) - 2000])
    whole = len(list(read_frames(counting[30])))
    assert 0 < len(list(read_frames(path))) < whole


def by_fast_start(raw: bytes, index: int) -> bytes:
    """The index moved behind the first box, and its offsets with it."""
    head = int.from_bytes(raw[:4], "big")
    moov = bytearray(raw[index:])
    at = moov.index(b"stco") + 12
    for k in range(int.from_bytes(moov[at - 4 : at], "big")):
        place = slice(at + 4 * k, at + 4 * k + 4)
        moov[place] = (int.from_bytes(moov[place], "big") + len(moov)).to_bytes(4, "big")
    return raw[:head] + bytes(moov) + raw[head:index]


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    cases = {
        "v.mp4": (b"RIFF\0\0\0\0WAVEfmt " + bytes(100), "not an MP4, AVI or Matroska file"),
        "v.avi": (b"RIFF\0\0\0\0AVI LIST" + bytes(100), "an AVI without a video track"),
        "v.mkv": (b"\x1a\x45\xdf\xa3" + bytes(100), "a Matroska file without a video track"),
        "v.m3u8": (b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "not an MP4, AVI or Matroska file"),
    }
    for name, (content, expected) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=expected):
            list(read_frames(tmp_path / name))
    with pytest.raises(InputError, match="is a folder"):
        probe_video(tmp_path)
