"""From images to tracks: corners spread evenly over the surface, followed by pyramidal Lucas-Kanade.

A point is followed from image to image and kept while three checks agree: followed back it returns to where it came
from, it moves as the affinity of its neighbours says (between successive images, and since it was first seen, which
catches slow sliding), and it stays on the object. Where tracks have thinned out new corners are taken up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.images import ImageSequence, Source
from connrsfm_graph.tracks.tracks import Tracks

_BLANK = 2.0
"""Standard deviation of grey levels (0 to 255) at and below which an image shows nothing."""
_BLACK = 8
"""Grey level (0 to 255) up to which a large area is taken for background that was cut away."""
_SPECK = 0.1
"""Areas smaller than this share of the largest one are not the object."""
_CORNER_FLOOR = 0.02
"""Weakest corner kept, as a share of the typical (median over cells) strongest one; weaker ones are noise."""
_LOST = 5.0
"""A point leaves its neighbours' affinity when its residual exceeds the limit and this many times the median."""


@dataclass(frozen=True)
class TrackingConfig:
    """How many points are followed and how far a track is trusted."""

    points: int = 1000
    """Cells the object is divided into; the strongest corner of each is followed."""
    window: int = 21
    """Side in pixels of the patch that is compared, odd."""
    levels: int = 3
    """Halvings of the image; the largest motion between images is about window * 2^levels / 2 pixels."""
    max_return_error: float = 0.7
    """Largest distance in pixels between a point and itself followed forward and back."""
    neighbours: int = 10
    """Nearest points whose affinity a point must follow."""
    max_affine_error: float = 2.0
    """Largest distance in pixels from where that affinity puts the point."""
    min_share: float = 0.5
    """Tracks seen in a smaller share of the images are dropped."""
    every: int = 1
    """Use every n-th image."""


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
        masks: images like `source`, not black where the object is. Without them everything but large black areas is
            the object.
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
        shown = _not_black(grey, config.window) if mask_images is None else _masked(mask_images, name, grey.shape)
        follower.add(grey, _inside(shown, config.window / 4), name)
        names.append(name)
        if progress is not None:
            progress(len(names), max(total, len(names)))
    return Tracks.checked(follower.tracks(), intrinsics, image_names=names, source="tracked images")


class _Follower:
    """The points followed so far; `at[i]` is where point `number[i]` is in the latest image."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.at = np.empty((0, 2), np.float32)
        self.number = np.empty(0, dtype=np.int64)
        self.first_at = np.empty((0, 2), np.float32)
        self.first_image = np.empty(0, dtype=np.int64)
        self.history: list[tuple[np.ndarray, np.ndarray]] = []
        self.cell = 0.0
        self.grey: np.ndarray | None = None

    def add(self, grey: np.ndarray, on_object: np.ndarray, name: str) -> None:
        """Follow all points into the next image and take up new ones where there are none."""
        if self.grey is not None:
            self._follow(self.grey, grey, on_object)
            if len(self.at) == 0:
                raise InputError(
                    f"{name}: none of the points of the image before is found again; is the motion too large?"
                )
        self.grey = grey
        if self.cell == 0.0:
            self.cell = float(np.sqrt(np.count_nonzero(on_object) / self.config.points))
        new = corners(grey, on_object, max(self.cell, 3.0), self.at)
        if not len(new) and not len(self.at):
            raise InputError(f"{name}: shows no corners to follow, expected a textured surface")
        start = self.first_image.size
        self.at = np.concatenate([self.at, new])
        self.number = np.concatenate([self.number, np.arange(start, start + len(new))])
        self.first_at = np.concatenate([self.first_at, new])
        self.first_image = np.concatenate([self.first_image, np.full(len(new), len(self.history))])
        self.history.append((self.number, self.at))

    def tracks(self) -> np.ndarray:
        """(F, P, 2) pixels of the tracks that last, NaN where lost."""
        frames = len(self.history)
        pixels = np.full((frames, self.first_image.size, 2), np.nan)
        for frame, (number, at) in enumerate(self.history):
            pixels[frame, number] = at
        lasting = np.isfinite(pixels[..., 0]).sum(axis=0) >= max(self.config.min_share * frames, min(2, frames))
        if not lasting.any():
            raise InputError(
                f"no track lasts {self.config.min_share:.0%} of the {frames} images, expected slower motion or a "
                "smaller share"
            )
        return pixels[:, lasting]

    def _follow(self, before: np.ndarray, after: np.ndarray, on_object: np.ndarray) -> None:
        config = self.config
        there, found = _lucas_kanade(before, after, self.at, config)
        back, returned = _lucas_kanade(after, before, there, config)
        good = found & returned & (np.linalg.norm(back - self.at, axis=1) <= config.max_return_error)
        height, width = on_object.shape
        x, y = np.nan_to_num(np.rint(there), nan=-1).clip(-1, 2**30).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        good &= inside
        good[inside] &= on_object[y[inside], x[inside]]
        good[good] = self._with_neighbours(self.at[good], there[good])
        for image in np.unique(self.first_image[self.number[good]]):
            born = np.flatnonzero(good & (self.first_image[self.number] == image))
            good[born] = self._with_neighbours(self.first_at[self.number[born]], there[born])
        self.at, self.number = there[good], self.number[good]

    def _with_neighbours(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(N,) bool, the points that move with their neighbours; all where there are too few to say."""
        if len(before) <= self.config.neighbours:
            return np.ones(len(before), dtype=bool)
        error = affine_error(before, after, self.config.neighbours)
        return error <= max(self.config.max_affine_error, _LOST * float(np.median(error)))


def _lucas_kanade(
    before: np.ndarray, after: np.ndarray, points: np.ndarray, config: TrackingConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) float32 of one image are in another, and whether they were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        points.copy(),
        winSize=(config.window, config.window),
        maxLevel=config.levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005),
    )
    return np.asarray(there), np.asarray(found).ravel() == 1


def corners(grey: np.ndarray, on_object: np.ndarray, cell: float, taken: np.ndarray) -> np.ndarray:
    """The strongest corner (Shi and Tomasi's smaller eigenvalue) of every cell of the image without a point.

    Args:
        grey: (H, W) uint8.
        on_object: (H, W) bool, where corners may lie.
        cell: side of a cell in pixels; corners keep half of it from each other and from points already taken.
        taken: (N, 2) pixels of the points already there.

    Returns:
        (M, 2) float32 pixels.
    """
    strength = np.where(on_object, cv2.cornerMinEigenVal(grey, 5), 0.0)
    peak = cv2.dilate(strength, np.ones((3, 3), np.uint8)) == strength
    y, x = np.nonzero(peak & (strength > 0))
    order = np.argsort(-strength[y, x], kind="stable")
    x, y = x[order], y[order]
    columns = int(np.ceil(grey.shape[1] / cell))
    index = (y // cell).astype(int) * columns + (x // cell).astype(int)
    _, best = np.unique(index, return_index=True)  # the first of each cell is its strongest
    if not len(best):
        return np.empty((0, 2), np.float32)
    best = np.sort(best)
    best = best[strength[y[best], x[best]] >= _CORNER_FLOOR * np.median(strength[y[best], x[best]])]
    candidates = np.column_stack([x[best], y[best]]).astype(np.float32)
    if len(taken):
        candidates = candidates[cKDTree(taken).query(candidates)[0] > cell]
    if not len(candidates):
        return candidates
    weaker = {b for _, b in cKDTree(candidates).query_pairs(cell / 2, output_type="ndarray")}
    return np.delete(candidates, sorted(weaker), axis=0)


def affine_error(before: np.ndarray, after: np.ndarray, neighbours: int) -> np.ndarray:
    """Distance (N,) in pixels between each point and where the affinity of its nearest neighbours puts it.

    The affinity from `before` to `after`, both (N, 2), is fitted by iteratively reweighted least squares (Cauchy
    weights scaled by the median residual), so one wrong neighbour does not condemn its surroundings.
    """
    _, near = cKDTree(before).query(before, neighbours + 1)
    near = near[:, 1:]
    offset = before[near] - before[:, None]
    scale = np.sqrt((offset**2).mean(axis=(1, 2), keepdims=True)) + 1e-9
    design = np.concatenate([offset / scale, np.ones((*near.shape, 1))], axis=2)
    motion = (after - before)[near].astype(np.float64)
    weight = np.ones(near.shape)
    for _ in range(4):
        weighted = design * weight[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, design) + 1e-6 * neighbours * np.eye(3)
        affinity = np.linalg.solve(normal, np.einsum("nki,nkj->nij", weighted, motion))
        residual = np.linalg.norm(motion - design @ affinity, axis=2)
        weight = 1 / (1 + (residual / (2 * np.median(residual, axis=1, keepdims=True) + 0.05)) ** 2)
    return np.linalg.norm(after - before - affinity[:, 2], axis=1)


def _not_black(grey: np.ndarray, window: int) -> np.ndarray:
    """(H, W) bool, everything but large black areas and specks."""
    bright = (cv2.blur(grey, (3, 3)) > _BLACK).astype(np.uint8)
    closed = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((window, window), np.uint8))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(closed)
    area = statistics[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0.0  # label 0 is the black rest
    return np.asarray((area >= _SPECK * area.max())[label])


def _masked(masks: Iterator[tuple[str, np.ndarray]], name: str, shape: tuple[int, ...]) -> np.ndarray:
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


def _inside(region: np.ndarray, margin: float) -> np.ndarray:
    """The part of a region that is further than `margin` pixels from its border; the image's own border is none."""
    distance = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(region & (distance > margin))
