"""Point tracks: where each point was seen in each image, and through which camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from connrsfm_graph.errors import InputError
from factors.surface import CAMERAS, PERSPECTIVE, Camera

_LARGEST = 1e100
"""Squares of larger coordinates are no numbers."""


@dataclass(frozen=True)
class Tracks:
    """Tracks of P points in F images. Build one with `Tracks.checked`, which validates; fields are then consistent."""

    pixels: np.ndarray
    """(F, P, 2) pixel coordinates, x right, y down, 0-based; NaN exactly where not visible."""
    K: np.ndarray
    """(F, 3, 3) intrinsics of every image: pinhole, or pixels per unit of length and principal point of an orthographic
    camera."""
    visible: np.ndarray
    """(F, P) bool, observed in that image."""
    points: np.ndarray | None = None
    """(F, P, 3) true points in the camera frame of each image, NaN where unknown."""
    normals: np.ndarray | None = None
    """(F, P, 3) true unit normals towards the camera, NaN where unknown."""
    image_names: tuple[str, ...] | None = None
    """File name of every image."""
    camera: Camera = PERSPECTIVE
    """How a pixel sees. Points of an orthographic camera are (u, v, beta), with a depth beta that may have any sign."""

    @property
    def n_frames(self) -> int:
        return self.pixels.shape[0]

    @property
    def n_points(self) -> int:
        return self.pixels.shape[1]

    def normalised(self) -> np.ndarray:
        """(F, P, 2) image coordinates K^-1 (x, y, 1), NaN where not visible."""
        homogeneous = np.concatenate([self.pixels, np.ones_like(self.pixels[..., :1])], axis=-1)
        rays = np.einsum("fij,fpj->fpi", np.linalg.inv(self.K), homogeneous)
        return rays[..., :2] / rays[..., 2:]

    def frame_name(self, frame: int) -> str:
        """How to call an image: its name, or its number."""
        return f"image {frame}" if self.image_names is None else self.image_names[frame]

    def focal_length(self) -> float:
        """Geometric mean of the focal lengths of all images, in pixels."""
        return float(np.exp(np.log(self.K[:, [0, 1], [0, 1]]).mean()))

    def select(
        self,
        frames: Sequence[int] | np.ndarray | slice = slice(None),
        points: Sequence[int] | np.ndarray | slice = slice(None),
    ) -> Tracks:
        """The tracks of some images and points."""

        def part(array: np.ndarray | None) -> np.ndarray | None:
            return None if array is None else array[frames][:, points]

        names = None if self.image_names is None else tuple(np.asarray(self.image_names)[frames])
        return replace(
            self,
            pixels=self.pixels[frames][:, points],
            K=self.K[frames],
            visible=self.visible[frames][:, points],
            points=part(self.points),
            normals=part(self.normals),
            image_names=names,
        )

    def mirrored(self) -> Tracks:
        """The tracks with the true surfaces mirrored in depth, which an orthographic camera sees alike."""
        points, normals = (
            None if array is None else array * sign
            for array, sign in ((self.points, np.array([1.0, 1.0, -1.0])), (self.normals, np.array([-1.0, -1.0, 1.0])))
        )
        return replace(self, points=points, normals=normals)

    @staticmethod
    def checked(
        pixels: np.ndarray,
        K: np.ndarray,
        visible: np.ndarray | None = None,
        points: np.ndarray | None = None,
        normals: np.ndarray | None = None,
        image_names: Sequence[str] | None = None,
        camera: str = PERSPECTIVE.name,
        source: str = "tracks",
    ) -> Tracks:
        """Validate arrays and build `Tracks`.

        Args:
            pixels: (F, P, 2).
            K: (3, 3) or (F, 3, 3).
            visible: (F, P) bool; where absent, the finite entries of `pixels`.
            points, normals: (F, P, 3) or None.
            image_names: F names or None.
            camera: `perspective` or `orthographic`.
            source: what to call the input in messages, usually the file's name.

        Raises:
            InputError: one sentence that names source, field and expectation.
        """
        pixels = _numeric(pixels, f"{source}: 'tracks'")
        if pixels.ndim != 3 or pixels.shape[2] != 2:
            raise InputError(f"{source}: 'tracks' has shape {pixels.shape}, expected (frames, points, 2)")
        F, P, _ = pixels.shape
        if F < 1 or P < 1:
            raise InputError(f"{source}: 'tracks' is empty, shape {pixels.shape}")
        K = _numeric(K, f"{source}: 'K'")
        if K.shape not in ((3, 3), (F, 3, 3)):
            raise InputError(f"{source}: 'K' has shape {K.shape}, expected (3, 3) or ({F}, 3, 3)")
        K = np.broadcast_to(K, (F, 3, 3)).copy()
        _check_intrinsics(K, source)
        finite = np.isfinite(pixels).all(axis=-1)
        if visible is None:
            visible = finite
        visible = np.asarray(visible)
        if visible.shape != (F, P):
            raise InputError(f"{source}: 'visible' has shape {visible.shape}, expected ({F}, {P})")
        if visible.dtype != bool and not np.isin(visible, (0, 1)).all():
            raise InputError(f"{source}: 'visible' holds values other than true and false")
        visible = visible.astype(bool)
        if (visible & ~finite).any():
            frame, point = np.argwhere(visible & ~finite)[0]
            raise InputError(
                f"{source}: 'tracks' is NaN or infinite at frame {frame}, point {point}, where 'visible' is true; "
                "mark it not visible or give its pixel"
            )
        pixels = np.where(visible[..., None], pixels, np.nan)
        if camera not in CAMERAS:
            raise InputError(f"{source}: 'camera' is '{camera}', expected one of {', '.join(CAMERAS)}")
        if image_names is not None and len(image_names) != F:
            raise InputError(f"{source}: 'image_names' has {len(image_names)} entries, expected {F}")
        return Tracks(
            pixels=pixels,
            K=K,
            visible=visible,
            points=_truth(points, (F, P, 3), f"{source}: 'points'"),
            normals=_truth(normals, (F, P, 3), f"{source}: 'normals'"),
            image_names=None if image_names is None else tuple(str(name) for name in image_names),
            camera=CAMERAS[camera],
        )


def _numeric(array: np.ndarray, what: str) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{what} holds {array.dtype} values, expected numbers")
    return array.astype(np.float64, copy=False)


def _truth(array: np.ndarray | None, shape: tuple[int, ...], what: str) -> np.ndarray | None:
    if array is None:
        return None
    array = _numeric(array, what)
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, expected {shape}")
    if (largest := np.abs(np.where(np.isfinite(array), array, 0.0)).max()) > _LARGEST:
        raise InputError(f"{what} holds numbers as large as {largest:.3g}, expected coordinates in some unit of length")
    return array.copy()


def _check_intrinsics(K: np.ndarray, source: str) -> None:
    if not np.isfinite(K).all():
        raise InputError(f"{source}: 'K' holds NaN or infinite values")
    if (K[:, [0, 1], [0, 1]] <= 0).any():
        raise InputError(f"{source}: 'K' has a non-positive focal length; the first two diagonal entries must be > 0")
    if (K[:, 1, 0] != 0).any() or (K[:, 2] != [0.0, 0.0, 1.0]).any():
        raise InputError(f"{source}: 'K' is not upper triangular with last row 0 0 1")
