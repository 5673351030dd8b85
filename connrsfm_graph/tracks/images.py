"""Images from a folder, a list of files or a video, one at a time, all of one size."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file

_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"}
_DAMAGED = re.compile(rb"premature end|bad Huffman|\d\d extraneous bytes", re.IGNORECASE)
"""What the decoder of JPEG says where it fills in what it cannot read; a few extraneous bytes are a camera's habit."""
Source = str | Path | Sequence[str | Path]


class ImageSequence:
    """Images in order; iterate for (name, image) with the image (H, W, 3) uint8, red, green, blue.

    Nothing is held in memory, so an iteration reads the files again.
    """

    def __init__(self, source: Source, every: int = 1, first: int = 0, last: int | None = None) -> None:
        """Take every `every`-th image from number `first` to `last` (both included, counted from 0; to the end where
        None) of a folder (by name, numbers in numerical order), of a list of files or of a video.

        Raises:
            InputError: no such folder or file, or a folder without images. What is wrong with one image (unreadable, of
                another size) is raised when it is reached.
        """
        if every < 1:
            raise InputError(f"every {every}-th image asked for, expected 1 or more")
        if first < 0 or (last is not None and last < first):
            raise InputError(f"images {first} to {last} asked for, expected two numbers from 0 in ascending order")
        self._chosen = slice(first, None if last is None else last + 1, every)
        self._video: Path | None = None
        if isinstance(source, str | Path):
            path = Path(source)
            if path.is_dir():
                self._files = sorted((f for f in path.iterdir() if f.suffix.lower() in _ENDINGS), key=_numerical)
                if not self._files:
                    raise InputError(f"{path}: holds no images, expected files such as 000.png or 000.jpg")
                return
            require_file(path)
            if path.suffix.lower() not in _ENDINGS:
                self._video = path
            self._files = [path]
        else:
            self._files = [Path(file) for file in source]
            if not self._files:
                raise InputError("the list of images is empty, expected files")

    def __len__(self) -> int:
        """Number of images; for a video what its header says, which may be off by some."""
        return len(self.names())

    def names(self) -> list[str]:
        """Names of all images, as they come with them; for a video as many as its header says."""
        if self._video is None:
            return [file.name for file in self._files[self._chosen]]
        with _decoders_messages():
            capture = cv2.VideoCapture(str(self._video))
        declared = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        capture.release()
        return [_frame_name(self._video, number) for number in range(declared)[self._chosen]]

    def __iter__(self) -> Iterator[tuple[str, np.ndarray]]:
        first: tuple[str, tuple[int, ...]] | None = None
        for name, image in self._read():
            if first is None:
                first = name, image.shape
            elif image.shape != first[1]:
                height, width = image.shape[:2]
                raise InputError(
                    f"{name}: has {width} x {height} pixels but {first[0]} has {first[1][1]} x {first[1][0]}, expected "
                    "one size because all images share one camera"
                )
            yield name, image

    def _read(self) -> Iterator[tuple[str, np.ndarray]]:
        if self._video is None:
            for file in self._files[self._chosen]:
                yield file.name, read_image(file)
            return
        frames = enumerate(_video_frames(self._video))
        for number, image in islice(frames, self._chosen.start, self._chosen.stop, self._chosen.step):
            yield _frame_name(self._video, number), image


def images_of(source: Source, names: Sequence[str] | np.ndarray | None, n_frames: int) -> Iterator[np.ndarray]:
    """The images (H, W, 3) uint8 RGB that tracks or a result belong to, in their order, one at a time.

    Args:
        source: folder, video, or list of image files; it may hold more images than are wanted.
        names: names of the wanted ones (the tracks' or result's `image_names`), or None where it has none.
        n_frames: how many are wanted. Where names are unknown to `source`, it must hold just so many.

    Raises:
        InputError: neither names nor number fit, at once or, for a video whose header is wrong, in the end; or what
            `ImageSequence` raises.
    """
    sequence = ImageSequence(source)
    wanted = set() if names is None else {str(name) for name in names}
    if wanted and wanted.issubset(sequence.names()):
        return _counted((image for name, image in sequence if name in wanted), n_frames, source)
    if len(sequence) != n_frames:
        known = "" if not wanted else f" or some named like {min(wanted)}"
        raise InputError(f"{source}: holds {len(sequence)} images, expected {n_frames}{known}")
    return _counted((image for _, image in sequence), n_frames, source)


def _counted(images: Iterator[np.ndarray], wanted: int, source: Source) -> Iterator[np.ndarray]:
    """The images; an error in the end where they were not so many, as a video's header may have promised."""
    number = 0
    for image in images:
        number += 1
        yield image
    if number != wanted:
        raise InputError(f"{source}: held {number} of the {wanted} images expected")


def _frame_name(video: Path, number: int) -> str:
    return f"{video.name} frame {number}"


def _video_frames(path: Path) -> Iterator[np.ndarray]:
    """All images of a video in the order in which they are shown, whatever time lies between them."""
    with _decoders_messages():
        capture = cv2.VideoCapture(str(path))
    try:
        number = 0
        while True:
            with _decoders_messages():
                read, image = capture.read()
            if not read:
                break
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise InputError(f"{path}: neither an image nor a video that can be decoded; convert it to MP4 or to images")


def read_image(path: Path) -> np.ndarray:
    """One image as (H, W, 3) uint8, red, green, blue.

    Raises:
        InputError: no such file, not an image, cut off or damaged.
    """
    require_file(path)
    data = path.read_bytes()
    image = None
    if data and _complete(data):
        with _decoders_messages() as messages:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if any(_DAMAGED.search(message) for message in messages):
            raise InputError(f"{path}: is damaged (a part of it cannot be decoded); leave it out or copy it again")
    if image is None:
        raise InputError(f"{path}: cannot be read as an image (truncated or of another format)")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def png_name(name: str) -> str:
    """What to call the image of that name when it is written as PNG."""
    path = Path(name)
    return f"{path.stem if path.suffix.lower() in _ENDINGS else name}.png"


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8 RGB to a file whose ending names its format."""
    done, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert done
    path.write_bytes(data.tobytes())


@contextmanager
def _decoders_messages() -> Iterator[list[bytes]]:
    """What compiled decoders print on standard error inside the block, instead of printing it; there when it ends."""
    messages: list[bytes] = []
    kept = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            caught.seek(0)
            messages.extend(caught.read().splitlines())


def _complete(data: bytes) -> bool:
    """Decoders fill the missing part of a cut-off JPEG or PNG with grey; its end marker tells."""
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[len(data) // 2 :]
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-64:]
    return True


def _numerical(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Key that sorts frame2 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts], path.name
