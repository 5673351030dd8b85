"""Images from a folder, a list of files or a video, one at a time, all of one size."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file

_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"}
Source = str | Path | Sequence[str | Path]


class ImageSequence:
    """Images in order; iterate for (name, image) with the image (H, W, 3) uint8, red, green, blue.

    Nothing is held in memory, so an iteration reads the files again.
    """

    def __init__(self, source: Source, every: int = 1) -> None:
        """Take every `every`-th image of a folder (by name, numbers in numerical order), of a list of files or a video.

        Raises:
            InputError: no such folder or file, or a folder without images. What is wrong with one image (unreadable, of
                another size) is raised when it is reached.
        """
        if every < 1:
            raise InputError(f"every {every}-th image asked for, expected 1 or more")
        self.every = every
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
        if self._video is None:
            return len(range(0, len(self._files), self.every))
        capture = cv2.VideoCapture(str(self._video))
        declared = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        capture.release()
        return len(range(0, declared, self.every))

    def __iter__(self) -> Iterator[tuple[str, np.ndarray]]:
        first: tuple[str, tuple[int, ...]] | None = None
        for name, image in islice(self._all(), 0, None, self.every):
            if first is None:
                first = name, image.shape
            elif image.shape != first[1]:
                height, width = image.shape[:2]
                raise InputError(
                    f"{name}: has {width} x {height} pixels but {first[0]} has {first[1][1]} x {first[1][0]}, expected "
                    "one size because all images share one camera"
                )
            yield name, image

    def _all(self) -> Iterator[tuple[str, np.ndarray]]:
        if self._video is None:
            for file in self._files:
                yield file.name, read_image(file)
            return
        capture = cv2.VideoCapture(str(self._video))
        try:
            number = 0
            while True:
                read, image = capture.read()
                if not read:
                    break
                yield f"{self._video.name} frame {number}", cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                number += 1
        finally:
            capture.release()
        if number == 0:
            raise InputError(f"{self._video}: neither an image nor a video that can be decoded")


def read_image(path: Path) -> np.ndarray:
    """One image as (H, W, 3) uint8, red, green, blue.

    Raises:
        InputError: no such file, not an image, or cut off.
    """
    require_file(path)
    data = path.read_bytes()
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data and _complete(data) else None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image (truncated or of another format)")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


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
