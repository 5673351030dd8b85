"""A small passing-camera problem shared by the tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.slam import FusionNoise, Sightings, SlamConfig
from connrsfm_graph.synthetic.passing_camera import PassingScene, noisy_odometry, passing_camera, relative_depth

IMAGE_SIGMA = 1e-3
NOISE = FusionNoise(image=IMAGE_SIGMA, depth=0.02, motion=0.003, scale=0.01)


@dataclass(frozen=True)
class Posed:
    scene: PassingScene
    sightings: Sightings
    steps: np.ndarray
    background: tuple[np.ndarray, np.ndarray]


def posed(n_frames: int = 12, n_points: int = 30, n_background: int = 20, gaps: float = 0.1, seed: int = 0) -> Posed:
    scene = passing_camera(n_frames, n_points, n_background, seed=seed)
    rng = np.random.default_rng(seed + 1)
    seen = scene.visible & (rng.uniform(size=scene.visible.shape) >= gaps)
    image = scene.image + IMAGE_SIGMA * rng.normal(size=scene.image.shape)
    steps, _ = noisy_odometry(scene.poses, seed=seed + 2)
    background = scene.background_image + IMAGE_SIGMA * rng.normal(size=scene.background_image.shape)
    return Posed(
        scene,
        Sightings.checked(image, relative_depth(scene, seed=seed + 3), seen),
        steps,
        (background, scene.background_visible),
    )


def sigmas(steps: np.ndarray) -> np.ndarray:
    return SlamConfig().odometry_sigmas(steps)
