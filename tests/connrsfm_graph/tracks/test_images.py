"""Images come in order and whole, or the one that is wrong is named."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.images import ImageSequence, images_of, read_image


def write(path: Path, value: int = 100, size: tuple[int, int] = (40, 60)) -> Path:
    image = np.random.default_rng(value).integers(0, 255, (*size, 3), dtype=np.uint8)
    image[0, 0] = (value, 0, 0)  # blue in OpenCV's order
    cv2.imwrite(str(path), image)
    return path


def test_folder_in_numerical_order_and_colours_in_rgb(tmp_path: Path) -> None:
    for name in ("frame10.png", "frame2.png", "Frame1.PNG", "frame3.png"):
        write(tmp_path / name, value=50)
    (tmp_path / "readme.txt").write_text("not an image")
    sequence = ImageSequence(tmp_path)
    names = [name for name, _ in sequence]
    assert names[-3:] == ["frame2.png", "frame3.png", "frame10.png"]
    assert len(sequence) == 4
    _, image = next(iter(sequence))
    assert image[0, 0].tolist() == [0, 0, 50]
    assert [name for name, _ in ImageSequence(tmp_path, every=3)] == [names[0], names[3]]
    assert len(ImageSequence(tmp_path, every=3)) == 2


def test_list_of_files(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.png") for name in "ba"]
    assert [name for name, _ in ImageSequence(files)] == ["b.png", "a.png"]


def test_video(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this build of OpenCV cannot write a video")
    for level in (30, 90, 150, 210):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    sequence = ImageSequence(path)
    assert len(sequence) == 4
    for _ in range(2):  # an iteration starts anew
        levels = [image.mean() for _, image in sequence]
        np.testing.assert_allclose(levels, [30, 90, 150, 210], atol=4)
    assert [name for name, _ in ImageSequence(path, every=2)] == ["film.avi frame 0", "film.avi frame 2"]


def test_video_of_variable_frame_rate_loses_no_image(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this build of OpenCV cannot write MP4")
    for level in (30, 90, 150, 210):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    path.write_bytes(uneven(path.read_bytes()))
    times = []
    capture = cv2.VideoCapture(str(path))
    while capture.read()[0]:
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    assert len(set(np.diff(times).round())) > 1, "the test's video should have a variable frame rate"
    levels = [image.mean() for _, image in ImageSequence(path)]
    np.testing.assert_allclose(levels, [30, 90, 150, 210], atol=4)


def uneven(movie: bytes) -> bytes:
    """An MP4 whose first image is shown a quarter as long: its table of times (stts) gets a second entry."""
    path = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts")
    starts, at, end = [], 0, len(movie)
    for kind in path:
        while movie[at + 4 : at + 8] != kind:
            at += struct.unpack(">I", movie[at : at + 4])[0]
            assert at < end
        starts.append(at)
        at += 8
    table = starts[-1]
    count, duration = struct.unpack(">II", movie[table + 16 : table + 24])
    entries = struct.pack(">IIIII", 2, 1, duration // 4, count - 1, duration)
    changed = bytearray(movie[: table + 12] + entries + movie[table + 24 :])
    for start in starts:
        (size,) = struct.unpack(">I", changed[start : start + 4])
        changed[start : start + 4] = struct.pack(">I", size + 8)
    return bytes(changed)


def test_images_of_a_result_by_name_or_number(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / f"{number}.png", value=10 * number)
    chosen = list(images_of(tmp_path, ["1.png", "3.png"], 2))
    assert [image[0, 0, 2] for image in chosen] == [10, 30]
    assert len(list(images_of(tmp_path, None, 4))) == 4
    assert len(list(images_of(tmp_path, ["a", "b", "c", "d"], 4))) == 4
    with pytest.raises(InputError, match=r"holds 4 images, expected 2 or some named like a\.png"):
        images_of(tmp_path, ["a.png", "b.png"], 2)


def test_decoders_do_not_speak_for_themselves(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for ending, match in (("png", "cannot be read"), ("jpg", "is damaged")):
        path = write(tmp_path / f"a.{ending}", size=(48, 64))
        data = bytearray(path.read_bytes())
        data[700:1500] = bytes([7]) * 800
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"a\.{ending}: {match}"):
            read_image(path)
    (tmp_path / "film.mp4").write_bytes(b"\0\0\0\x18ftypisom" + b"\0" * 500)
    with pytest.raises(InputError, match="convert it to MP4 or to images"):
        list(ImageSequence(tmp_path / "film.mp4"))
    assert capfd.readouterr().err == ""


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.*no such file"):
        ImageSequence(tmp_path / "none")
    with pytest.raises(InputError, match="holds no images"):
        ImageSequence(tmp_path)
    with pytest.raises(InputError, match="list of images is empty"):
        ImageSequence([])
    with pytest.raises(InputError, match="1 or more"):
        ImageSequence(tmp_path, every=0)
    with pytest.raises(InputError, match="images 5 to 2 asked for"):
        ImageSequence(tmp_path, first=5, last=2)
    (tmp_path / "film.mp4").write_bytes(b"no film" * 100)
    with pytest.raises(InputError, match=r"film\.mp4: neither an image nor a video"):
        list(ImageSequence(tmp_path / "film.mp4"))
    write(tmp_path / "0.png")
    write(tmp_path / "1.png", size=(40, 61))
    with pytest.raises(InputError, match=r"1\.png: has 61 x 40 pixels but 0\.png has 60 x 40"):
        list(ImageSequence(tmp_path))


@pytest.mark.parametrize("ending", ["png", "jpg", "bmp"])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_cut_off_images(tmp_path: Path, ending: str, share: float) -> None:
    path = write(tmp_path / f"a.{ending}")
    read_image(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    if ending == "bmp" and share == 0.9:
        return  # decoders cannot tell
    with pytest.raises(InputError, match=r"a\..*: cannot be read as an image"):
        read_image(path)
