"""Where tracks come from: files of several layouts, or images."""

from connrsfm_graph.tracks.tracks import Tracks

__all__ = ["Tracks"]
