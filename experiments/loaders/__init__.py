"""Data sets that the reader must download, one module each.

A module names its data set in `DATASET`; a new file here adds one. `python -m experiments.loaders` lists where each is
to be had and what its loader expects; `python -m experiments.loaders NAME FOLDER OUT.npz` converts one to a track file
that every command reads. Layouts are those of the publications' code as far as it is public; where only images or
matrices are published, the expected folder is described instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from connrsfm_graph.tracks import Tracks


@dataclass(frozen=True)
class Dataset:
    """A public data set."""

    title: str
    """What it shows, images and points."""
    source: str
    """Where it is to be had."""
    expects: str
    """What must lie in the folder given to `load`."""
    load: Callable[[Path], Tracks]
    """Reads that folder; raises InputError where something is missing."""


def datasets() -> dict[str, Dataset]:
    """All data sets by the name of their module; modules that start with an underscore are shared layouts."""
    names = sorted(module.name for module in iter_modules(__path__) if not module.name.startswith("_"))
    return {name: import_module(f"{__name__}.{name}").DATASET for name in names}
