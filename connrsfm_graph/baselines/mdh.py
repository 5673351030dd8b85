"""`mdh`: inextensible non-rigid structure from motion by the maximum-depth heuristic.

Chhatkuli, Pizarro, Collins, Bartoli, "Inextensible non-rigid structure-from-motion by second-order cone programming",
TPAMI 2018: among all surfaces whose points are no farther apart than lengths shared by all images, take the one with
the largest sum of depths. Convex, so the optimum is global.

As published, but for the temporal smoothness of videos, which is left out. Published 3D error on the T-shirt: 0.88 %;
0.74 to 0.78 % from the authors' public code; 0.80 % here.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.baselines.inextensible import InextensibleProgramme
from connrsfm_graph.baselines.outcome import outcome
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks

NEIGHBOURS = 12
"""Edges from every point of the nearest-neighbour graph."""


def reconstruct(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct by the maximum-depth heuristic; the configuration is not used.

    Raises:
        ComputationError: the programme has no optimum, or no image is recovered.
    """
    with progress.stage("neighbours"):
        programme = InextensibleProgramme.of(tracks.normalised(), tracks.visible, NEIGHBOURS)
    with progress.stage("cone programme"):
        legs, _ = programme.maximise(programme.rays[..., 2])
    log_depth = np.log(np.where(legs > 0, legs * programme.rays[..., 2], np.nan))
    settings = {"neighbours": NEIGHBOURS}
    decisions = {
        "edges": len(programme.edges),
        "scale convention": "edge lengths are shared by all images, their sum is 1",
    }
    return outcome(tracks, log_depth, "mdh", settings, decisions, progress)
