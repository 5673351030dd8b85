"""Where tracks come from: files of several layouts, or images."""

from connrsfm_graph.tracks.load import load_tracks, save_tracks
from connrsfm_graph.tracks.tracks import Tracks

__all__ = ["Tracks", "load_tracks", "save_tracks"]
