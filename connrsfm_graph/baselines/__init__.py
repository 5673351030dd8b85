"""Methods to compare with, each in one file, run through the same interface as the main job.

A baseline is a function `(Tracks, Config, Progress) -> (Reconstruction, RunRecord)` in a module of its own, named in
`BASELINES`. It runs with the settings of its publication; of the configuration it uses what its docstring says, the
record lists the settings it ran with. `python -m experiments tshirt` measures the errors that docstrings call "here".
Modules are imported when they are first called, because some need the solvers of the extra `baselines`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from connrsfm_graph.errors import InputError, missing_package

if TYPE_CHECKING:
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruct import Config
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.run_record import RunRecord
    from connrsfm_graph.tracks import Tracks

    Method = Callable[[Tracks, Config, Progress], tuple[Reconstruction, RunRecord]]


def _imported(name: str) -> Method:
    """The function `reconstruct` of the baseline's module, imported when it is called."""

    def run(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
        if not tracks.camera.kappa:
            raise InputError(f"the baseline '{name}' is for perspective cameras, the tracks are {tracks.camera.name}")
        try:
            module = import_module(f"connrsfm_graph.baselines.{name}")
        except ModuleNotFoundError as error:
            raise missing_package(f"the baseline '{name}'", str(error.name), "baselines") from error
        return module.reconstruct(tracks, config, progress)

    return run


BASELINES: dict[str, Method] = {name: _imported(name) for name in ("infp", "go20", "diff", "mdh", "mlh")}
"""Baselines by name; one more file here and one more name is all a new one needs."""
