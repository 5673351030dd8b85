"""Global refinement over latent edge lengths that all views share."""

from connrsfm_graph.refine.config import RefineConfig
from connrsfm_graph.refine.stage import Refined, refine

__all__ = ["RefineConfig", "Refined", "refine"]
