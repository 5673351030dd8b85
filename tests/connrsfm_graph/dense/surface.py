"""A known bent sheet seen by a camera, as a reconstruction with its images: what the tests of dense surfaces share."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from connrsfm_graph.reconstruction import Reconstruction

SIZE = (320, 240)
K = np.array([[300.0, 0.0, 161.0], [0.0, 280.0, 118.0], [0.0, 0.0, 1.0]])


def true_log_depth(pixels: np.ndarray, frame: int = 0) -> np.ndarray:
    """Log depth of the sheet at pixels (..., 2) of a frame."""
    u, v = np.moveaxis((pixels - K[:2, 2]) / K[[0, 1], [0, 1]], -1, 0)
    return np.log(3.0) + 0.4 * u - 0.2 * v + (0.5 + 0.1 * frame) * u**2 - 0.4 * u * v + 0.3 * v**3


def true_normals(pixels: np.ndarray, frame: int = 0) -> np.ndarray:
    """Unit normals (..., 3) of the sheet towards the camera, by differences of `true_log_depth`."""
    h = 1e-4
    y = [
        (true_log_depth(pixels + h * step, frame) - true_log_depth(pixels - h * step, frame)) / (2 * h) * K[axis, axis]
        for axis, step in enumerate(np.eye(2))
    ]
    u, v = np.moveaxis((pixels - K[:2, 2]) / K[[0, 1], [0, 1]], -1, 0)
    n = np.stack([y[0], y[1], -(1.0 + u * y[0] + v * y[1])], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def sheet(n_frames: int = 3, n_points: int = 200, hole: float = 0.0) -> Reconstruction:
    """The sheet at random points, but for those within `hole` pixels of the image's middle, and at its corners."""
    rng = np.random.default_rng(1)
    low, high = np.array([40.0, 30.0]), np.array([280.0, 200.0])
    pixels = rng.uniform(low, high, (4 * n_points, 2))
    pixels = pixels[np.linalg.norm(pixels - np.array(SIZE) / 2, axis=1) > hole][: n_points - 4]
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [low[0], high[1]], [high[0], high[1]]])
    pixels = np.tile(np.concatenate([corners, pixels]), (n_frames, 1, 1))
    F, P = n_frames, n_points
    depth = np.exp(np.stack([true_log_depth(pixels[f], f) for f in range(F)]))
    rays = np.concatenate([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((F, P, 1))], axis=-1)
    return Reconstruction(
        pixels=pixels,
        K=np.tile(K, (F, 1, 1)),
        visible=np.ones((F, P), bool),
        points=rays * depth[..., None],
        normals=np.stack([true_normals(pixels[f], f) for f in range(F)]),
        depth=depth,
        first_order=np.zeros((F, P, 2)),
        second_order=np.zeros((F, P, 3)),
        edges=np.zeros((0, 2), int),
        edge_weight=np.zeros(0),
        conformal_scale=np.zeros((0, P)),
        depth_std=np.full((F, P), np.nan),
        log_factor=np.zeros((F, P)),
        interpolated=np.zeros((F, P), bool),
        outlier=np.zeros((F, P), bool),
        image_names=np.array([f"{f:03d}.png" for f in range(F)]),
    )


def write_images(folder: Path, count: int = 3, size: tuple[int, int] = SIZE) -> Path:
    """Images whose red and green channels are the pixels' places, in a new folder."""
    folder.mkdir()
    x, y = np.meshgrid(np.linspace(0, 255, size[0]), np.linspace(0, 255, size[1]))
    for f in range(count):
        bgr = np.stack([np.full_like(x, 40 * f), y, x], axis=-1).astype(np.uint8)
        cv2.imwrite(str(folder / f"{f:03d}.png"), bgr)
    return folder
