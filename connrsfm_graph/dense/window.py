"""The network's frame of reference: normals of any camera and any part of an image as one kind of picture.

A window is the rectangle of pixels around an image's sparse points, with coordinates p in [-1, 1]^2. Up to a constant,
log depth over the window follows from its gradient g there. With the sight ray r = (u, v, 1) and the surface normal n
towards the camera, the gradient of log depth by (u, v) is -(n1, n2) / (n . r); with A = d(u, v)/dp it is

    g = -A^T (n1, n2) / (n . r)     so that     m = (-g, 1) / |(-g, 1)|  is along  -(A^T (n1, n2), n . r).

m is the unit normal of the surface (p, log depth): three channels that hold all of g, whatever the intrinsics, the
distance and the size of the surface in the image. It is linear in n before it is normalised, hence kind to noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEEPEST = 0.3
"""Smallest third component of m that is let through, slopes of about 3: noise may turn normals away from the camera."""


@dataclass(frozen=True)
class Window:
    """A rectangle of an image and the camera behind it."""

    centre: np.ndarray
    """(2,) pixels."""
    half: np.ndarray
    """(2,) half of width and height in pixels."""
    K: np.ndarray
    """(3, 3) intrinsics."""

    @staticmethod
    def around(pixels: np.ndarray, K: np.ndarray) -> Window:
        """The bounding box of pixels (N, 2)."""
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        half = 0.5 * (high - low)
        # A line of points has no second side; any will do.
        return Window(0.5 * (low + high), np.maximum(half, 1e-3 * half.max() + 1e-12), K)

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """Window coordinates p (N, 2) of pixels (N, 2)."""
        return (pixels - self.centre) / self.half

    def encode(self, normals: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Unit normals m (..., 3) of the log-depth surface from surface normals (..., 3) at p (..., 2)."""
        inverse = np.linalg.inv(self.K)
        origin = inverse @ np.append(self.centre, 1.0)
        A = inverse[:2, :2] * self.half
        return encode(normals, p @ A.T + origin[:2], A)


def encode(normals: np.ndarray, image: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Unit normals m of log-depth surfaces, broadcast over leading dimensions.

    Args:
        normals: (..., 3) surface normals, of any length, towards the camera.
        image: (..., 2) normalised coordinates u, v.
        A: (..., 2, 2) derivatives of u, v by window coordinates.
    """
    across = np.einsum("...ki,...k->...i", A, normals[..., :2])
    along = (normals[..., :2] * image).sum(axis=-1) + normals[..., 2]
    m = -np.concatenate([across, along[..., None]], axis=-1)
    m /= np.maximum(np.linalg.norm(m, axis=-1, keepdims=True), np.finfo(float).tiny)
    m[..., 2] = np.maximum(m[..., 2], STEEPEST)
    return m / np.linalg.norm(m, axis=-1, keepdims=True)


def slopes(m: np.ndarray) -> np.ndarray:
    """Gradient g (..., 2) of log depth by window coordinates from m (..., 3)."""
    return -m[..., :2] / np.maximum(m[..., 2:], STEEPEST)


def grid(size: int) -> np.ndarray:
    """(size,) window coordinates of the pixels of the network's images, at the pixels' centres."""
    return (2.0 * np.arange(size) + 1.0) / size - 1.0


@dataclass(frozen=True)
class Conditioned:
    """Images of normals without the part that needs no network.

    Log depth is linear in g. The mean of g is a tilt whose log depth is a plane, and a factor on g is one on log depth:
    both are taken out before the network and put back after it, so that gentle and strong relief look alike to it.
    """

    images: np.ndarray
    """(B, S, S, 3) float32 unit normals of slopes with zero mean and unit root mean square; 0 off the surface."""
    tilt: np.ndarray
    """(B, 2) mean of g over the surface."""
    scale: np.ndarray
    """(B,) root mean square of what is left."""

    @staticmethod
    def of(images: np.ndarray, mask: np.ndarray) -> Conditioned:
        """Condition images of normals m (B, S, S, 3) on surfaces (B, S, S) bool."""
        g = np.where(mask[..., None], slopes(np.where(mask[..., None], images, 1.0)), 0.0)
        pixels = np.maximum(mask.sum(axis=(1, 2)), 1)
        tilt = g.sum(axis=(1, 2)) / pixels[:, None]
        rest = np.where(mask[..., None], g - tilt[:, None, None], 0.0)
        scale = np.sqrt((rest**2).sum(axis=(1, 2, 3)) / pixels) + 1e-9
        unit = np.concatenate([-rest / scale[:, None, None, None], np.ones((*mask.shape, 1))], axis=-1)
        unit *= mask[..., None] / np.linalg.norm(unit, axis=-1, keepdims=True)
        return Conditioned(unit.astype(np.float32), tilt, scale)

    def reduced(self, log_depth: np.ndarray) -> np.ndarray:
        """(B, S, S) what the network should answer for true log depths (B, S, S)."""
        return (log_depth - self._plane(log_depth.shape[-1])) / self.scale[:, None, None]

    def restored(self, answer: np.ndarray) -> np.ndarray:
        """(B, S, S) log depth from the network's answer (B, S, S)."""
        return answer * self.scale[:, None, None] + self._plane(answer.shape[-1])

    def _plane(self, size: int) -> np.ndarray:
        p = grid(size)
        return self.tilt[:, 0, None, None] * p + self.tilt[:, 1, None, None] * p[:, None]
