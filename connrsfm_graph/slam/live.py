"""Tracks in, poses and a deforming map out, view by view.

The first views are reconstructed together; what they get wrong no later one mends, so they must show the surface from
sides some tens of degrees apart. Every later one gets its surface from keyframes (`keyframes`, `new_view`), is fused
with all before (`incremental`), and may become a keyframe itself.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam.cameras import start_cameras
from connrsfm_graph.slam.incremental import IncrementalConfig, IncrementalFusion
from connrsfm_graph.slam.keyframes import KeyframeConfig, Keyframes
from connrsfm_graph.slam.noise import FusionNoise, estimate_noise, image_noise
from connrsfm_graph.slam.run import SlamConfig
from connrsfm_graph.slam.sightings import Sightings
from factors.keys import VIEW_SCALE, key


class LiveFusion:
    """The growing estimate and its keyframes."""

    def __init__(
        self,
        first: Sightings,
        noise: FusionNoise,
        steps: np.ndarray | None = None,
        sigmas: np.ndarray | None = None,
        pose: np.ndarray | None = None,
        config: IncrementalConfig | None = None,
        keyframes: KeyframeConfig | None = None,
    ):
        """Take in the first views.

        Args:
            first: reconstruction of the first views, whose unit that of all others will be.
            noise: noise levels.
            steps, sigmas: odometry between the first views as in `cameras.add_odometry`, or None.
            pose: (4, 4) of the first view; the origin of the world where None.
            config, keyframes: settings.

        Raises:
            InputError: the first views cannot be fused.
        """
        start = start_cameras(first, noise, steps, sigmas, pose)
        log_scale = float(start.atVector(key(VIEW_SCALE, 0, 0))[0])
        self.fusion = IncrementalFusion(noise, config, pose, log_scale)
        """All estimates."""
        self.keyframes = Keyframes(keyframes)
        """What new views get their surfaces from."""
        for number in range(first.n_views):
            view = first.view(number)
            if number and steps is not None and sigmas is not None:
                self.fusion.add_view(view, steps[number - 1], sigmas[number - 1])
            else:
                self.fusion.add_view(view)
            self.keyframes.offer(view)

    def add(
        self,
        points: np.ndarray,
        image: np.ndarray,
        step: np.ndarray | None = None,
        sigmas: np.ndarray | None = None,
        factors: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
    ) -> int:
        """Take in the tracks of the next view.

        Args:
            points: (N,) numbers of the points seen, each once.
            image: (N, 2) normalised image coordinates.
            step, sigmas, factors, values: as in `IncrementalFusion.add_view`.

        Returns:
            Number of the view.

        Raises:
            InputError: the view cannot be used; the message says why and everything is as it was before.
        """
        try:
            view = self.keyframes.depths(points, image)
        except InputError as error:
            raise InputError(f"view {self.fusion.n_views}: {error}; the view was not added") from error
        number = self.fusion.add_view(view, step, sigmas, factors, values)
        self.keyframes.offer(view)
        return number


def fuse_live(
    first: Sightings,
    image: np.ndarray,
    visible: np.ndarray,
    config: SlamConfig | None = None,
    steps: np.ndarray | None = None,
    pose: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LiveFusion:
    """Take in a recorded sequence view by view, with noise levels from its first views.

    Args:
        first: reconstruction of the first K views.
        image: (F, P, 2) normalised image coordinates of all views, any value where not visible.
        visible: (F, P) bool.
        config: settings.
        steps: (F-1, 4, 4) odometry between all views, or None.
        pose: (4, 4) of the first view; the origin of the world where None.
        progress: called with (views taken in, F).

    Raises:
        InputError: a view cannot be used.
    """
    config = config or SlamConfig()
    F, K = len(image), first.n_views
    sigmas = None if steps is None else config.odometry_sigmas(steps)
    sigma = image_noise(image[:K], visible[:K])
    incremental = IncrementalConfig(map=config.fusion.map)
    live = LiveFusion(
        first,
        estimate_noise(first, sigma),
        None if steps is None else steps[: K - 1],
        None if sigmas is None else sigmas[: K - 1],
        pose,
        incremental,
        KeyframeConfig(image_sigma=max(sigma, 1e-6)),
    )
    for view in range(K, F):
        (points,) = np.nonzero(visible[view])
        if steps is None or sigmas is None:
            live.add(points, image[view, points])
        else:
            live.add(points, image[view, points], steps[view - 1], sigmas[view - 1])
        if progress is not None:
            progress(view + 1, F)
    return live
