"""Where tracks come from: files of several layouts, or images."""

from connrsfm_graph.tracks.check import check_reconstructable
from connrsfm_graph.tracks.intrinsics import parse_intrinsics
from connrsfm_graph.tracks.load import load_tracks, save_tracks
from connrsfm_graph.tracks.tracks import Tracks

__all__ = ["Tracks", "check_reconstructable", "load_tracks", "parse_intrinsics", "save_tracks"]
