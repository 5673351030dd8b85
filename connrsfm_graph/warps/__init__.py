"""Image warps: a smooth map between the two images of every edge, and its first and second derivatives."""

from connrsfm_graph.warps.config import WarpConfig
from connrsfm_graph.warps.fit import WarpReport, Warps, fit_warps
from connrsfm_graph.warps.noise import estimate_pixel_noise

__all__ = ["WarpConfig", "WarpReport", "Warps", "estimate_pixel_noise", "fit_warps"]
