"""From images to tracks: corners spread evenly over the surface, followed by pyramidal Lucas-Kanade.

From image to image a point is kept while three checks agree: followed back it returns to where it came from, it moves
as the affinity of its neighbours says, and the patch around it, registered with that affinity, still looks as it did
when the point was first seen. The registration also removes the errors that would add up from image to image. Where
points have thinned out new corners are taken up, and lost points where they are seen again (see `rejoin`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.check import MIN_FRAMES
from connrsfm_graph.tracks.config import TrackingConfig
from connrsfm_graph.tracks.corners import corners, inside, not_black
from connrsfm_graph.tracks.images import ImageSequence, Source
from connrsfm_graph.tracks.neighbours import local_affinity
from connrsfm_graph.tracks.register import patches, register
from connrsfm_graph.tracks.rejoin import Features, matches, predicted
from connrsfm_graph.tracks.tracks import Tracks

_BLANK = 2.0
"""Standard deviation of grey levels (0 to 255) at and below which an image shows nothing."""
_MIN_CELL = 3.0
"""Pixels; corners closer than this share their patches."""
_JUMP = 0.5
"""Where a smaller share of the points is followed into the next image, the motion was too large to follow."""
_REFERENCES = 12
"""Earlier images kept to find lost points again, spread over all that were; at most so many."""
_TRIES = 3
"""Of these, how many are matched with an image: those in which most lost points were seen."""
_REACH = 4.0
"""Cells within which matches must lie to predict a lost point."""


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
    chosen = (config.every, config.first, config.last)
    images = ImageSequence(source, *chosen)
    mask_images = None if masks is None else iter(ImageSequence(masks, *chosen))
    total = len(images)
    follower = _Follower(config)
    names: list[str] = []
    for name, image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if grey.std() <= _BLANK:
            raise InputError(
                f"{name}: is blank (all pixels nearly alike), expected a textured surface; leave it out, or choose a "
                "part of the images by the settings first and last"
            )
        region = not_black(grey, config.patch) if mask_images is None else _next_mask(mask_images, name, grey.shape)
        follower.add(grey, inside(region, config.patch / 4), name)
        names.append(name)
        if progress is not None:
            progress(len(names), max(total, len(names)))
    surplus = None if mask_images is None else next(mask_images, None)
    if surplus is not None:
        raise InputError(f"mask {surplus[0]}: has no image, expected as many masks as images")
    if len(names) < MIN_FRAMES:
        shown = "1 image" if len(names) == 1 else f"{len(names)} images"
        if chosen != (1, 0, None):
            shown += " in the part chosen by first, last and every"
        raise InputError(f"{_named(source)}: shows {shown}, expected at least {MIN_FRAMES} of a surface that moves")
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

    def take(self, which: np.ndarray) -> _Points:
        return _Points(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True)
class _Reference:
    """An earlier image, to find lost points again."""

    features: Features
    points: _Points
    """As they were in that image."""

    def lost(self, alive: _Points) -> np.ndarray:
        """(N,) bool, its points that are not followed any more."""
        return ~np.isin(self.points.number, alive.number)


class _Follower:
    """The points followed so far and where they have been."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.cell = 0.0
        self.n_tracks = 0
        self.grey = np.empty((0, 0), np.uint8)
        self.on_object = np.empty((0, 0), bool)
        self.points: _Points | None = None
        self.references: list[_Reference] = []
        self.history: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, grey: np.ndarray, on_object: np.ndarray, name: str) -> None:
        """Follow all points into the next image, find lost ones again and take up new ones where there are none."""
        if self.points is None:
            self.cell = max(float(np.sqrt(np.count_nonzero(on_object) / self.config.points)), _MIN_CELL)
            self.points = self._new(grey, corners(grey, on_object, self.cell, np.empty((0, 2))))
            if not self.n_tracks:
                raise InputError(f"{name}: shows no corners to follow, expected a textured surface")
            features = self._features(grey, on_object)
        else:
            followed = self._followed(self.points, grey, on_object)
            jump = len(followed.at) < _JUMP * len(self.points.at)
            features = self._features(grey, on_object, jump)
            if features is not None:
                if jump:
                    self.references.append(_Reference(Features.of(self.grey, self.on_object), self.points))
                followed = self._found_again(followed, features, grey, on_object)
            if not len(followed.at):
                raise InputError(
                    f"{name}: none of the points of the image before is found again; is the motion too large?"
                )
            self.points = followed.and_also(self._new(grey, corners(grey, on_object, self.cell, followed.at)))
        if features is not None:
            self.references.append(_Reference(features, self.points))
            if len(self.references) > _REFERENCES:
                self.references = self.references[::2]
        self.grey, self.on_object = grey, on_object
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

    def _features(self, grey: np.ndarray, on_object: np.ndarray, jump: bool = False) -> Features | None:
        """Those of an image that is matched with others, None of the rest."""
        every = self.config.rejoin
        return Features.of(grey, on_object) if every and (jump or len(self.history) % every == 0) else None

    def _found_again(self, alive: _Points, features: Features, grey: np.ndarray, on_object: np.ndarray) -> _Points:
        """The points followed and those that earlier images show where to find."""
        for reference in sorted(self.references, key=lambda reference: -reference.lost(alive).sum())[:_TRIES]:
            lost = reference.points.take(reference.lost(alive))
            _, there, here = np.intersect1d(reference.points.number, alive.number, return_indices=True)
            before, after = matches(reference.features, features)
            before = np.concatenate([reference.points.at[there], before])
            after = np.concatenate([alive.at[here], after])
            near, place, step = predicted(before, after, lost.at, self.config.neighbours, _REACH * self.cell)
            lost = lost.take(near)
            at, affinity, similarity = register(lost.patch, grey, place, step @ lost.affinity)
            sure = self._trusted(at, place, similarity, on_object)
            found = _Points(lost.number[sure], at[sure].astype(np.float32), affinity[sure], lost.patch[sure])
            if len(found.at):
                # A corner taken up in the meantime at the same place is the younger track and ends.
                distance, nearest = (
                    cKDTree(found.at).query(alive.at) if len(alive.at) else (np.empty(0), np.empty(0, int))
                )
                young = (distance < self.cell / 2) & (alive.number > found.number[nearest])
                alive = alive.take(~young).and_also(found)
        return alive

    def _trusted(
        self, at: np.ndarray, expected: np.ndarray, similarity: np.ndarray, on_object: np.ndarray
    ) -> np.ndarray:
        """(N,) bool, the patches registered at `at` look as at first, are near where expected, and on the object."""
        near = np.linalg.norm(at - expected, axis=1) <= self.config.max_affine_error
        return near & (similarity >= self.config.min_similarity) & _within(on_object, at)

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
        kept = (error <= config.max_affine_error) & self._trusted(at, there, similarity, on_object)
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


def _named(source: Source) -> str:
    return str(source) if isinstance(source, str | Path) else "the list of images"


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
