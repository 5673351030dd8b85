"""Maps and fusion problems in files.

A problem is saved by what it is made of: GTSAM's own factors by GTSAM, the map by the arrays its factors are built
from. Factors written in Python cannot be saved by GTSAM, so a graph that holds some is refused.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz, written_beside
from connrsfm_graph.slam.assemble import MapModel
from connrsfm_graph.slam.fuse import Fused
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.sightings import Sightings
from factors.keys import describe


@dataclass(frozen=True)
class FusionProblem:
    """All that `fuse` takes."""

    sightings: Sightings
    """The reconstruction."""
    noise: FusionNoise
    """Noise levels."""
    model: MapModel
    """How the map moves."""
    graph: gtsam.NonlinearFactorGraph
    """Everything but the map."""
    values: gtsam.Values
    """Where its variables start."""


def save_problem(path: str | Path, problem: FusionProblem) -> None:
    """Write a problem as `.npz`.

    Raises:
        InputError: the graph holds a factor written in Python.
    """
    for n in range(problem.graph.size()):
        factor = problem.graph.at(n)
        if isinstance(factor, gtsam.CustomFactor):
            names = ", ".join(describe(k) for k in factor.keys())
            raise InputError(
                f"{path}: the factor on {names} is written in Python and cannot be saved; add it on loading"
            )
    arrays: dict[str, np.ndarray] = {name: getattr(problem.sightings, name) for name in _SIGHTINGS}
    arrays["noise"] = np.array([getattr(problem.noise, name) for name in _NOISE])
    arrays["motion"] = np.array(problem.model.motion)
    arrays["huber"] = np.array(problem.model.huber)
    arrays["graph"] = np.frombuffer(problem.graph.serialize().encode(), dtype=np.uint8)
    arrays["values"] = np.frombuffer(problem.values.serialize().encode(), dtype=np.uint8)
    with written_beside(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load_problem(path: str | Path) -> FusionProblem:
    """Read a problem written by `save_problem`; read only files you trust, GTSAM's format does not check itself.

    Raises:
        InputError: the file cannot be read or lacks a field.
    """
    arrays = read_npz(path)
    for name in (*_SIGHTINGS, "noise", "motion", "huber", "graph", "values"):
        if name not in arrays:
            raise InputError(f"{path}: field '{name}' is missing; expected a problem written by 'connrsfm slam'")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    try:
        graph.deserialize(arrays["graph"].tobytes().decode())
        values.deserialize(arrays["values"].tobytes().decode())
    except (RuntimeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: 'graph' or 'values' cannot be read by this version of GTSAM") from error
    model = asdict(MapModel()) | {"motion": str(arrays["motion"]), "huber": float(arrays["huber"])}
    return FusionProblem(
        Sightings.checked(**{name: arrays[name] for name in _SIGHTINGS}),
        FusionNoise(*(float(x) for x in arrays["noise"])),
        MapModel(**model),
        graph,
        values,
    )


_SIGHTINGS = ("image", "log_depth", "seen", "depth_std")
_NOISE = ("image", "depth", "motion", "scale")


def write_map(path: str | Path, fused: Fused, view: int | None = None) -> None:
    """Write the map points of one view, or of all, as a binary PLY with the numbers of view and point."""
    chosen = np.isfinite(fused.points).all(axis=-1)
    if view is not None:
        chosen &= (np.arange(len(chosen)) == view)[:, None]
    views, points = np.nonzero(chosen)
    table = np.empty(len(views), dtype=[(name, "<f4") for name in "xyz"] + [("view", "<i4"), ("point", "<i4")])
    for axis, name in enumerate("xyz"):
        table[name] = fused.points[chosen][:, axis]
    table["view"], table["point"] = views, points
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in "xyz"] + ["property int view", "property int point", "end_header\n"]
    with written_beside(path) as part:
        part.write_bytes("\n".join(header).encode() + table.tobytes())
