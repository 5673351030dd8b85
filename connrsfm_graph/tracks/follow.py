"""From images to tracks: corners spread evenly over the surface, followed by pyramidal Lucas-Kanade.

From image to image a point is kept while three checks agree: followed back it returns to where it came from, it moves
as the affinity of its neighbours says, and the patch around it, registered with that affinity, still looks as it did
when the point was first seen. The registration also removes the errors that would add up from image to image. Where
points have thinned out new corners are taken up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import cv2
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.corners import corners, inside, not_black
from connrsfm_graph.tracks.images import ImageSequence, Source
from connrsfm_graph.tracks.neighbours import local_affinity
from connrsfm_graph.tracks.register import patches, register
from connrsfm_graph.tracks.tracks import Tracks

_BLANK = 2.0
"""Standard deviation of grey levels (0 to 255) at and below which an image shows nothing."""
_MIN_CELL = 3.0
"""Pixels; corners closer than this share their patches."""


@dataclass(frozen=True)
class TrackingConfig:
    """How many points are followed and how far a track is trusted."""

    points: int = 1000
    """Cells the object is divided into; the strongest corner of each is followed."""
    patch: int = 21
    """Side in pixels of the patch that is compared, odd."""
    levels: int = 3
    """Halvings of the image; the largest motion between images is about patch * 2^levels / 2 pixels."""
    max_return_error: float = 0.7
    """Largest distance in pixels between a point and itself followed forward and back."""
    neighbours: int = 10
    """Nearest points whose affinity a point must follow."""
    max_affine_error: float = 2.0
    """Largest distance in pixels from where that affinity puts the point, and from where registration puts it."""
    min_similarity: float = 0.7
    """Least correlation of the patch with how it looked at first."""
    min_share: float = 0.5
    """Tracks seen in a smaller share of the images are dropped."""
    every: int = 1
    """Use every n-th image."""

    def __post_init__(self) -> None:
        if self.patch < 5 or self.patch % 2 == 0:
            raise ValueError(f"patch is {self.patch}, expected an odd number from 5")
        if not 0 < self.min_share <= 1:
            raise ValueError(f"min_share is {self.min_share}, expected more than 0 and at most 1")
        for name, least in (("points", 1), ("levels", 0), ("neighbours", 3), ("every", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, expected {least} or more")


def track_images(
    source: Source,
    intrinsics: np.ndarray,
    config: TrackingConfig | None = None,
    masks: Source | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Follow points through images.

    Args:
        source: folder, video, or list of image files.
        intrinsics: (3, 3) pinhole intrinsics in pixels.
        config: numbers and limits.
        masks: images like `source`, bright where the object is. Without them everything but large black areas is the
            object.
        progress: called with the number of images done and in all.

    Returns:
        Tracks seen in at least `min_share` of the images, in order of appearance.

    Raises:
        InputError: no, corrupt, blank or unequal images, no corners, or an image at which all points are lost.
    """
    config = config or TrackingConfig()
    images = ImageSequence(source, config.every)
    mask_images = None if masks is None else iter(ImageSequence(masks, config.every))
    total = len(images)
    follower = _Follower(config)
    names: list[str] = []
    for name, image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if grey.std() <= _BLANK:
            raise InputError(f"{name}: is blank (all pixels nearly alike), expected a textured surface; leave it out")
        region = not_black(grey, config.patch) if mask_images is None else _next_mask(mask_images, name, grey.shape)
        follower.add(grey, inside(region, config.patch / 4), name)
        names.append(name)
        if progress is not None:
            progress(len(names), max(total, len(names)))
    return Tracks.checked(follower.tracks(), intrinsics, image_names=names, source="tracked images")


@dataclass(frozen=True)
class _Points:
    """N points that are being followed."""

    number: np.ndarray
    """(N,) which track a point belongs to."""
    at: np.ndarray
    """(N, 2) float32 pixels in the latest image."""
    affinity: np.ndarray
    """(N, 2, 2) distortion of the patch since it was first seen."""
    patch: np.ndarray
    """(N, side, side) float32, as first seen."""

    def and_also(self, more: _Points) -> _Points:
        return _Points(*(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self)))


class _Follower:
    """The points followed so far and where they have been."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.cell = 0.0
        self.n_tracks = 0
        self.grey = np.empty((0, 0), np.uint8)
        self.points: _Points | None = None
        self.history: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, grey: np.ndarray, on_object: np.ndarray, name: str) -> None:
        """Follow all points into the next image and take up new ones where there are none."""
        if self.points is None:
            self.cell = max(float(np.sqrt(np.count_nonzero(on_object) / self.config.points)), _MIN_CELL)
            self.points = self._new(grey, corners(grey, on_object, self.cell, np.empty((0, 2))))
            if not self.n_tracks:
                raise InputError(f"{name}: shows no corners to follow, expected a textured surface")
        else:
            followed = self._followed(self.points, grey, on_object)
            if not len(followed.at):
                raise InputError(
                    f"{name}: none of the points of the image before is found again; is the motion too large?"
                )
            self.points = followed.and_also(self._new(grey, corners(grey, on_object, self.cell, followed.at)))
        self.grey = grey
        self.history.append((self.points.number, self.points.at))

    def tracks(self) -> np.ndarray:
        """(F, P, 2) pixels of the tracks that last, NaN where lost."""
        n_frames = len(self.history)
        pixels = np.full((n_frames, self.n_tracks, 2), np.nan)
        for frame, (number, at) in enumerate(self.history):
            pixels[frame, number] = at
        lasting = np.isfinite(pixels[..., 0]).mean(axis=0) >= self.config.min_share
        if not lasting.any():
            raise InputError(
                f"no point is followed through {self.config.min_share:.0%} of the {n_frames} images, expected slower "
                "motion or a smaller share"
            )
        return pixels[:, lasting]

    def _new(self, grey: np.ndarray, at: np.ndarray) -> _Points:
        number = np.arange(self.n_tracks, self.n_tracks + len(at))
        self.n_tracks += len(at)
        return _Points(number, at, np.tile(np.eye(2), (len(at), 1, 1)), patches(grey, at, self.config.patch))

    def _followed(self, points: _Points, grey: np.ndarray, on_object: np.ndarray) -> _Points:
        config = self.config
        there, found = _lucas_kanade(self.grey, grey, points.at, config)
        back, returned = _lucas_kanade(grey, self.grey, there, config)
        good = found & returned & (np.linalg.norm(back - points.at, axis=1) <= config.max_return_error)
        good = np.flatnonzero(good)
        there = there[good]

        step, error = local_affinity(points.at[good], there, config.neighbours)
        at, affinity, similarity = register(points.patch[good], grey, there, step @ points.affinity[good])
        kept = (error <= config.max_affine_error) & (similarity >= config.min_similarity)
        kept &= (np.linalg.norm(at - there, axis=1) <= config.max_affine_error) & _within(on_object, at)
        good = good[kept]
        return _Points(points.number[good], at[kept].astype(np.float32), affinity[kept], points.patch[good])


def _lucas_kanade(
    before: np.ndarray, after: np.ndarray, points: np.ndarray, config: TrackingConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) float32 of one image are in another, and whether they were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        points.copy(),
        winSize=(config.patch, config.patch),
        maxLevel=config.levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
    )
    return np.asarray(there), np.asarray(found).ravel() == 1


def _within(region: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N,) bool, the pixels (N, 2) that lie in a region (H, W)."""
    height, width = region.shape
    x, y = np.rint(np.clip(at, -1, max(width, height))).astype(int).T
    in_image = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return in_image & region[np.where(in_image, y, 0), np.where(in_image, x, 0)]


def _next_mask(masks: Iterator[tuple[str, np.ndarray]], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool, the next mask."""
    mask_name, mask = next(masks, (None, None))
    if mask_name is None or mask is None:
        raise InputError(f"{name}: has no mask, expected as many masks as images")
    if mask.shape[:2] != shape:
        raise InputError(
            f"mask {mask_name}: has {mask.shape[1]} x {mask.shape[0]} pixels, expected the {shape[1]} x {shape[0]} of "
            f"{name}"
        )
    return np.asarray(mask.max(axis=2) > 127)
