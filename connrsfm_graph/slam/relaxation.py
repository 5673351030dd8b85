"""Relaxation of a whole trajectory: every view moves as a similarity and keeps the shape of its surface.

What a window of views holds fixed too early - the unit of the reconstruction in that of odometry, the drift - is right
for the shapes and wrong for the cameras. With the shapes given the anchors have nothing to say, and the cost is that of
a pose graph of similarities: the motion of the surface between views (`factors.surface_motion`) and all factors on the
cameras. It is sparse, a chain where no track is lost, and the work is proportional to the number of views.
"""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np

from connrsfm_graph.slam.assemble import link_scales
from connrsfm_graph.slam.growing_map import GrowingMap
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.solvers.gtsam_backend import levenberg_marquardt
from connrsfm_graph.solvers.interface import Levenberg
from factors.surface_motion import surface_motion_factor


def relaxed(
    known: GrowingMap, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, noise: FusionNoise, settings: Levenberg
) -> gtsam.Values:
    """Poses, scales and the graph's other variables at the minimum for the shapes at hand.

    Args:
        known: the map.
        graph: all factors but those of the map and the links between scales; they fix the gauge.
        values: current estimate.
        noise: noise levels.
        settings: of the minimisation.
    """
    pose_graph = gtsam.NonlinearFactorGraph(graph)
    for a, b in pairwise(range(known.n_views)):
        pose_graph.add(link_scales(a, b, noise))
    for views, rows in known.motions.items():
        shapes = np.stack([known.shape[n][list(mine)] for n, mine in zip(views, zip(*rows, strict=True), strict=True)])
        pose_graph.add(surface_motion_factor(views, shapes, noise.motion))
    values, _, _ = levenberg_marquardt(pose_graph, values, settings)
    return values
