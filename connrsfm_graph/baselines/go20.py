"""`go20`: isometric non-rigid structure from motion on a graph of images with chosen edges.

Chen, Zhao, Zhang, Huang, "Dense isometric non-rigid shape-from-motion based on graph optimization and edge selection",
RA-L 2020, as far as its successor describes it: the pairs of images are a maximum spanning tree and the k-ESP edges
beside it, and the first-order terms of all images are estimated together from the four isometric equations of every
pair, with the Schwarzian warps of `paper` mode. This is the pre-step of Con-NRSfM followed by integration.

Not reproduced, for want of a description: its dense interpolation and edge weights. Published 3D error on the T-shirt:
2.33 %; here 1.46 %, from better warps.
"""

from __future__ import annotations

from dataclasses import replace

from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, default_config
from connrsfm_graph.reconstruct import reconstruct as main_job
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks


def reconstruct(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct by the isometric pre-step; of the configuration, `graph` and `integrate` are used.

    Raises:
        InputError, ComputationError: as the main job.
    """
    paper = default_config("paper")
    own = replace(paper, graph=config.graph, integrate=config.integrate, solve=replace(paper.solve, schedule="none"))
    reconstruction, record = main_job(tracks, own, progress)
    return reconstruction, replace(record, method="go20")
