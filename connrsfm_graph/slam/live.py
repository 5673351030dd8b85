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
from connrsfm_graph.slam.growing_background import GrowingBackground
from connrsfm_graph.slam.growing_graph import push_back
from connrsfm_graph.slam.incremental import IncrementalConfig, IncrementalFusion
from connrsfm_graph.slam.keyframes import KeyframeConfig, Keyframes
from connrsfm_graph.slam.noise import FusionNoise, estimate_noise, image_noise
from connrsfm_graph.slam.run import SlamConfig
from connrsfm_graph.slam.sightings import Sightings, View
from factors.keys import VIEW_SCALE, describe, key


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
        background: tuple[np.ndarray, np.ndarray] | None = None,
    ):
        """Take in the first views.

        Args:
            first: reconstruction of the first views, whose unit that of all others will be.
            noise: noise levels.
            steps, sigmas: odometry between the first views as in `cameras.add_odometry`, or None.
            pose: (4, 4) of the first view; the origin of the world where None.
            config, keyframes: settings.
            background: image points (F, B, 2), normalised, and visibility (F, B) of points that do not move, in the
                first views.

        Raises:
            InputError: the first views cannot be fused.
        """
        start = start_cameras(first, noise, steps, sigmas, pose)
        log_scale = float(start.atVector(key(VIEW_SCALE, 0, 0))[0])
        self.fusion = IncrementalFusion(noise, config, pose, log_scale)
        """All estimates."""
        self.keyframes = Keyframes(keyframes)
        """What new views get their surfaces from."""
        distance = float(np.median(np.exp(first.log_depth[first.seen] + log_scale)))
        self.background = GrowingBackground(noise.image, distance)
        """What the views saw of points that do not move."""
        self.held: list[int] = []
        """Views that showed too little of the surface."""
        for number in range(first.n_views):
            step, deviations = None, None
            if number and steps is not None and sigmas is not None:
                step, deviations = steps[number - 1], sigmas[number - 1]
            self._take_in(first.view(number), step, deviations, rigid=_sighted(background, number))

    def add(
        self,
        points: np.ndarray,
        image: np.ndarray,
        step: np.ndarray | None = None,
        sigmas: np.ndarray | None = None,
        factors: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
        rigid: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> int:
        """Take in the tracks of the next view.

        Args:
            points: (N,) numbers of the points seen, each once.
            image: (N, 2) normalised image coordinates.
            step, sigmas, factors, values: as in `IncrementalFusion.add_view`.
            rigid: numbers (M,) and image points (M, 2) of the points seen that do not move, numbered on their own.

        Returns:
            Number of the view.

        Raises:
            InputError: the view cannot be used; the message says why and everything is as it was before.
        """
        try:
            view = self.keyframes.depths(points, image)
        except InputError as error:
            raise InputError(f"view {self.fusion.n_views}: {error}; the view was not added") from error
        return self._take_in(view, step, sigmas, factors, values, rigid)

    def hold(self, step: np.ndarray, sigmas: np.ndarray, rigid: tuple[np.ndarray, np.ndarray] | None = None) -> int:
        """Take in a view that shows too little of the surface: odometry and background place its camera.

        Args:
            step, sigmas, rigid: as in `add`.

        Returns:
            Number of the view.

        Raises:
            InputError: the view cannot be used; the message says why and everything is as it was before.
        """
        nothing = View.checked(np.empty(0, dtype=int), np.empty((0, 2)), np.empty(0))
        number = self._take_in(nothing, step, sigmas, rigid=rigid)
        self.held.append(number)
        return number

    def _take_in(
        self,
        view: View,
        step: np.ndarray | None = None,
        sigmas: np.ndarray | None = None,
        factors: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
        rigid: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> int:
        """Fuse a view and, once that is done, keep what later ones need of it."""
        number = self.fusion.n_views
        if rigid is not None:
            try:
                graph, starts = self.background.factors(number, *rigid, self.fusion.pose)
                for k in [] if values is None else values.keys():
                    if starts.exists(k):
                        raise InputError(f"{describe(k)} is there already")
            except InputError as error:
                raise InputError(f"view {number}: {error}; the view was not added") from error
            if factors is not None:
                push_back(graph, factors)
            if values is not None:
                starts.insert(values)
            factors, values = graph, starts
        self.fusion.add_view(view, step, sigmas, factors, values)
        if rigid is not None:
            self.background.take_in(number, *rigid)
        if len(view.points):
            self.keyframes.offer(view)
        return number


def _sighted(background: tuple[np.ndarray, np.ndarray] | None, view: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Numbers and image points of what a view saw of the background."""
    if background is None:
        return None
    image, visible = background
    (points,) = np.nonzero(visible[view])
    return points, image[view, points]


def fuse_live(
    first: Sightings,
    image: np.ndarray,
    visible: np.ndarray,
    config: SlamConfig | None = None,
    steps: np.ndarray | None = None,
    pose: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
    background: tuple[np.ndarray, np.ndarray] | None = None,
) -> LiveFusion:
    """Take in a recorded sequence view by view, with noise levels from its first views.

    Where there is odometry, views that show too little of the surface are held by it and the background.

    Args:
        first: reconstruction of the first K views.
        image: (F, P, 2) normalised image coordinates of all views, any value where not visible.
        visible: (F, P) bool.
        config: settings.
        steps: (F-1, 4, 4) odometry between all views, or None.
        pose: (4, 4) of the first view; the origin of the world where None.
        progress: called with (views taken in, F).
        background: image points (F, B, 2), normalised, and visibility (F, B) of points that do not move.

    Raises:
        InputError: a view cannot be used, an image point is not finite, or numbers of views do not fit.
    """
    config = config or SlamConfig()
    F, K = len(image), first.n_views
    wrong = (visible & ~np.isfinite(image).all(axis=-1)).any(axis=1)
    if wrong.any():  # which would pass for too little of the surface
        raise InputError(f"view {int(wrong.argmax())}: an image point is NaN where 'visible' is true")
    if background is not None and len(background[1]) != F:
        raise InputError(f"the background is tracked through {len(background[1])} views, the points through {F}")
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
        background,
    )
    for view in range(K, F):
        (points,) = np.nonzero(visible[view])
        if steps is None or sigmas is None:
            live.add(points, image[view, points], rigid=_sighted(background, view))
        else:
            odometry = steps[view - 1], sigmas[view - 1]
            try:
                live.add(points, image[view, points], *odometry, rigid=_sighted(background, view))
            except InputError:  # whatever is wrong with more than the surface is told once more
                live.hold(*odometry, _sighted(background, view))
        if progress is not None:
            progress(view + 1, F)
    live.fusion.relax()
    return live
