"""Methods by name: ours and the baselines, each a function from tracks and configuration to a reconstruction."""

from __future__ import annotations

from collections.abc import Callable

from connrsfm_graph.baselines import BASELINES
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, reconstruct
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks

METHODS: dict[str, Callable[[Tracks, Config, Progress], tuple[Reconstruction, RunRecord]]] = {
    "connrsfm": reconstruct,
    **BASELINES,
}
"""A method is one more entry."""
