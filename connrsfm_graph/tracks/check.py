"""Whether tracks can be reconstructed, said before hours are spent on them.

What makes a reconstruction impossible is an error that names the image or the number; what one can live with is mended
by hiding observations, so that shapes stay as given, and told as a warning.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.image_graph import image_change
from connrsfm_graph.tracks.tracks import Tracks

MIN_FRAMES = 3
"""Two images of a bending surface leave two solutions for its normals at every point."""
MIN_POINTS = 6
"""A warp needs more than the three points an affinity passes through exactly."""
_SAME_PIXEL = 1e-6
"""Points closer than this, in pixels, are at the same place; finer than any tracker measures."""
_THIN = 1e-4
"""Points whose spread across is less than this share of their spread along lie on a line."""
_WILD = 1e3
"""A point farther from the middle of its image than so many median distances is no point of the surface."""
_SPREAD = (1e-6, 1e3)
"""Image points spread over at least and at most so many focal lengths; generously more units where orthographic."""
_STILL = 1e-8
"""Images of which less than this share of the layout changes do not differ (see `image_graph.image_change`)."""
_COMPARISONS = 8
"""Other images each image's handedness is compared with."""
_AT_ONCE = 256
"""Images whose handedness is found together; bounds the memory, not the result."""


def check_reconstructable(tracks: Tracks, source: str = "tracks") -> tuple[Tracks, tuple[str, ...]]:
    """Tracks fit for a reconstruction, and a warning for everything that was hidden or looks wrong.

    Where several points lie at the same pixel of an image only the first stays visible there: the surface between them
    would have no extent. A point far outside its image, as failed trackers report, is not visible there.

    Args:
        tracks: any consistent tracks.
        source: what to call them in messages, usually the file's name.

    Raises:
        InputError: too few images or points, an image that shows too few points or only points on a line, a mirrored
            image, or no point seen twice.
    """
    if tracks.n_frames < MIN_FRAMES:
        shown = "1 image" if tracks.n_frames == 1 else f"{tracks.n_frames} images"
        raise InputError(
            f"{source}: shows {shown}, expected at least {MIN_FRAMES} because two views of a bending "
            "surface leave its normals ambiguous"
        )
    if tracks.n_points < MIN_POINTS:
        raise InputError(
            f"{source}: holds {tracks.n_points} points, expected at least {MIN_POINTS} to warp one image to another"
        )
    empty = np.flatnonzero(~tracks.visible.any(axis=1))
    if len(empty):
        raise InputError(f"{source}: {_frames(tracks, empty)} shows no point at all; leave it out")
    rare = _rarely_seen(tracks, source)
    tracks, wild = _hide_wild(tracks)
    tracks, coincident = _hide_coincident(tracks)
    counts = tracks.visible.sum(axis=1)
    poor = np.flatnonzero(counts < MIN_POINTS)
    if len(poor):
        raise InputError(
            f"{source}: {_frames(tracks, poor)} shows {counts[poor[0]]} points, expected at least {MIN_POINTS}; leave "
            "it out or track more points"
        )
    _refuse_camera(tracks, source)
    _refuse_lines(tracks, source)
    _refuse_mirrored(tracks, source)
    _refuse_still(tracks, source)
    return tracks, (*coincident, *wild, *rare, *_odd_camera(tracks))


def _hide_coincident(tracks: Tracks) -> tuple[Tracks, list[str]]:
    visible = tracks.visible.copy()
    hidden_in = np.zeros(tracks.n_points, dtype=int)
    twin = np.zeros(tracks.n_points, dtype=int)
    for frame in range(tracks.n_frames):
        seen = np.flatnonzero(visible[frame])
        cells = np.round(tracks.pixels[frame, seen] / _SAME_PIXEL)
        _, first, which = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        kept = seen[first[which.ravel()]]
        later = seen != kept
        visible[frame, seen[later]] = False
        hidden_in[seen[later]] += 1
        twin[seen[later]] = kept[later]
    if not hidden_in.any():
        return tracks, []
    worst = int(np.argmax(hidden_in))
    warning = (
        f"{np.count_nonzero(hidden_in)} points lie at the same pixel as another one (point {worst} as point "
        f"{twin[worst]}, in {hidden_in[worst]} images); the later of them is taken as not visible there"
    )
    return replace(tracks, visible=visible, pixels=np.where(visible[..., None], tracks.pixels, np.nan)), [warning]


def _hide_wild(tracks: Tracks) -> tuple[Tracks, list[str]]:
    visible = tracks.visible.copy()
    for seen, points in zip(visible, tracks.pixels, strict=True):
        distance = np.hypot(*(points - np.median(points[seen], axis=0)).T)
        typical = np.median(distance[seen])
        seen &= ~(distance > _WILD * typical) | (typical == 0.0)
    wild = np.argwhere(tracks.visible & ~visible)
    if not len(wild):
        return tracks, []
    frame, point = wild[0]
    warning = (
        f"{len(wild)} observations lie far outside the others of their image (the first is point {point} of "
        f"{tracks.frame_name(frame)}, at {np.abs(tracks.pixels[frame, point]).max():.3g} pixels); they are left out"
    )
    return replace(tracks, visible=visible, pixels=np.where(visible[..., None], tracks.pixels, np.nan)), [warning]


def _refuse_camera(tracks: Tracks, source: str) -> None:
    """Intrinsics that leave nothing of the image, or no perspective that double precision could show."""
    least, most = _SPREAD if tracks.camera.kappa else (_SPREAD[0] ** 10, _SPREAD[1] ** 10)
    with np.errstate(over="ignore", invalid="ignore"):
        image = tracks.normalised()
        spread, off = float(np.nanmedian(np.nanstd(image, axis=1))), float(np.nanmedian(np.abs(image)))
    if not least < spread < most or not off < most:
        raise InputError(
            f"{source}: the points spread over {spread:.2g} focal lengths, {off:.2g} off the camera's axis, expected "
            f"between {least:g} and {most:g}; do the intrinsics belong to these pixels?"
        )


def _refuse_lines(tracks: Tracks, source: str) -> None:
    for frame in range(tracks.n_frames):
        points = tracks.pixels[frame, tracks.visible[frame]]
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= _THIN * spread[0]:
            raise InputError(
                f"{source}: all points of {tracks.frame_name(frame)} lie on one line, expected a surface; leave it out"
            )


def _refuse_mirrored(tracks: Tracks, source: str) -> None:
    """The warp between two images of one side of a surface keeps handedness, so its best affinity has det > 0."""
    F = tracks.n_frames
    others = np.unique(np.linspace(1, F - 1, min(_COMPARISONS, F - 1)).round().astype(int))
    flipped = np.zeros(F, dtype=int)
    compared = np.zeros(F, dtype=int)
    for first in range(0, F, _AT_ONCE):
        frames = np.arange(first, min(first + _AT_ONCE, F))
        for other in others:
            second = (frames + other) % F
            both = tracks.visible[frames] & tracks.visible[second]
            enough = both.sum(axis=1) >= MIN_POINTS
            flipped[frames] += enough & (_handedness(tracks.pixels[frames], tracks.pixels[second], both) < 0)
            compared[frames] += enough
    mirrored = np.flatnonzero(2 * flipped > compared)
    if len(mirrored):
        raise InputError(
            f"{source}: {_frames(tracks, mirrored)} shows the points mirrored against the other images; turn x (or y) "
            "around there, or leave it out"
        )


def _refuse_still(tracks: Tracks, source: str) -> None:
    """Images that are shifted, turned or scaled copies of each other hold no information about the surface."""
    order = np.arange(tracks.n_frames)
    change = image_change(tracks.visible, tracks.pixels, np.stack([order, np.roll(order, 1)], axis=-1))
    if change.max() < _STILL:
        raise InputError(
            f"{source}: the images differ by no more than a shift, a rotation and a scale, expected a surface that "
            "moves or deforms in front of the camera"
        )


def _handedness(a: np.ndarray, b: np.ndarray, both: np.ndarray) -> np.ndarray:
    """(N,) sign of the determinant of the affinities that best map points a to b, (N, P, 2) each, where both (N, P) are
    seen; 0 where nearly singular."""
    seen = both[..., None]
    count = np.maximum(seen.sum(axis=1, keepdims=True), 1)
    a, b = (np.where(seen, x - np.where(seen, x, 0.0).sum(axis=1, keepdims=True) / count, 0.0) for x in (a, b))
    A = np.linalg.pinv(a.mT @ a, hermitian=True) @ (a.mT @ b)
    det = np.linalg.det(A)
    return np.where(np.abs(det) <= 0.01 * (A**2).sum(axis=(1, 2)), 0.0, np.sign(det))


def _rarely_seen(tracks: Tracks, source: str) -> list[str]:
    rare = np.flatnonzero(tracks.visible.sum(axis=0) < 2)
    if len(rare) == tracks.n_points:
        raise InputError(f"{source}: no point is seen in two images, expected points that link the images")
    if not len(rare):
        return []
    return [f"{len(rare)} points are seen in fewer than two images (the first is point {rare[0]}): nothing fixes them"]


def _odd_camera(tracks: Tracks) -> list[str]:
    """Signs that pixels and intrinsics do not belong together."""
    if not tracks.camera.kappa:
        return []
    if tracks.focal_length() < 10:
        return [
            f"the focal length is {tracks.focal_length():.3g} pixels: are the tracks in normalised coordinates? "
            "Noise levels are stated in pixels"
        ]
    angle = np.degrees(np.arctan(np.nanmax(np.hypot(*np.moveaxis(tracks.normalised(), -1, 0)))))
    if angle > 75:
        return [f"points lie up to {angle:.0f} degrees off the camera's axis: does K belong to these pixels?"]
    return []


def _frames(tracks: Tracks, numbers: np.ndarray) -> str:
    """``image 3``, or ``image 3 (and 2 others)``; by its name where it has one."""
    others = len(numbers) - 1
    return tracks.frame_name(numbers[0]) + (f" (and {others} other{'s' if others > 1 else ''})" if others else "")
