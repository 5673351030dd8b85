"""What a reconstruction yields: the surfaces (`result.npz`) and the record of how they came about (`run.json`)."""

from __future__ import annotations

import json
import platform
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz, require_file, write_npz, written_beside
from factors.surface import CAMERAS, PERSPECTIVE, Camera

RESULT_FILE = "result.npz"
RECORD_FILE = "run.json"


@dataclass(frozen=True)
class Reconstruction:
    """Surfaces of F images at P points and the conformal scale on E edges of the image graph.

    Camera frame of each image: x right, y down, z forward. Depths are relative: one scale is free for the whole
    sequence, and the scale of each image's surface is fixed by the stage that says so in the run's record.
    """

    pixels: np.ndarray
    """(F, P, 2) the input tracks in pixels, NaN where not visible."""
    K: np.ndarray
    """(F, 3, 3) intrinsics of every image: pinhole, or pixels per unit and principal point where orthographic."""
    visible: np.ndarray
    """(F, P) bool, the point was observed in that image."""
    points: np.ndarray
    """(F, P, 3) surface points in the camera frame of each image, NaN where not recovered."""
    normals: np.ndarray
    """(F, P, 3) unit normals towards the camera, NaN where not recovered."""
    depth: np.ndarray
    """(F, P) depth beta along z, NaN where not recovered."""
    first_order: np.ndarray
    """(F, P, 2) y1, y2: first derivatives of depth by normalised image coordinates, divided by depth."""
    second_order: np.ndarray
    """(F, P, 3) y11, y12, y22: second derivatives of depth, divided by depth."""
    edges: np.ndarray
    """(E, 2) images a and b of each edge of the image graph."""
    edge_weight: np.ndarray
    """(E,) weight of each edge."""
    conformal_scale: np.ndarray
    """(E, P) conformal scale lambda of each point from image a to image b, NaN where the pair was not observed."""
    depth_std: np.ndarray
    """(F, P) standard deviation of depth in units of depth, NaN where not estimated."""
    log_factor: np.ndarray
    """(F, P) log conformal factor phi of the refinement, zero for an isometric surface, NaN where not estimated."""
    interpolated: np.ndarray
    """(F, P) bool, recovered from the surface around it rather than from the point's own pairs."""
    outlier: np.ndarray
    """(F, P) bool, observed but judged a wrong track."""
    image_names: np.ndarray | None = None
    """(F,) names of the images, or None where the tracks had none."""
    ambiguous: np.ndarray | None = None
    """(F,) int, of a conformal surface: 0 for images whose surface is decided; those of the same positive number may be
    inverted about the camera centre, but only together. None where no image is ambiguous."""
    alternative: np.ndarray | None = None
    """(F, P, 3) the points with all ambiguous images inverted; None where no image is ambiguous."""
    camera: Camera = PERSPECTIVE
    """How a pixel sees. The depth of an orthographic camera is about its mean in each image, its terms are derivatives
    of depth as they stand, and the mirror image of all surfaces in depth fits as well."""

    @property
    def n_frames(self) -> int:
        return self.points.shape[0]

    @property
    def n_points(self) -> int:
        return self.points.shape[1]

    @property
    def recovered(self) -> np.ndarray:
        """(F, P) bool, the surface point is known."""
        return np.isfinite(self.points).all(axis=-1)

    def frame_name(self, frame: int) -> str:
        """How to call an image: its file's name, or its number."""
        return f"image {frame}" if self.image_names is None else str(self.image_names[frame])

    def save(self, path: str | Path) -> None:
        """Write `result.npz`; the same reconstruction gives the same bytes."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays["camera"] = None if self.camera is PERSPECTIVE else np.array(self.camera.name)
        with written_beside(path) as part:
            write_npz(part, {name: array for name, array in arrays.items() if array is not None})

    @staticmethod
    def load(path: str | Path) -> Reconstruction:
        """Read `result.npz`, or the folder that holds it; fields this version does not know are ignored.

        Large arrays are mapped from the file, not read (see `files.write_npz`); changes to them stay in memory.

        Raises:
            InputError: the file cannot be read, or a field is absent or has a wrong shape or type.
        """
        path = Path(path)
        if path.is_dir():
            path = path / RESULT_FILE
            if not path.exists():
                raise InputError(f"{path.parent}: holds no {RESULT_FILE}; expected a folder written by 'reconstruct'")
        arrays = read_npz(path)
        sizes: dict[str, int] = {}
        known = {name: _checked(arrays, name, spec, sizes, str(path)) for name, spec in _LAYOUT.items()}
        names = arrays.get("image_names")
        if names is not None and (names.shape != (sizes["F"],) or names.dtype.kind != "U"):
            raise InputError(f"{path}: 'image_names' is not a list of {sizes['F']} names")
        if known["edges"].size and not np.isin(known["edges"], np.arange(sizes["F"])).all():
            raise InputError(f"{path}: 'edges' names an image outside 0 to {sizes['F'] - 1}")
        optional = {
            name: _checked(arrays, name, spec, sizes, str(path)) for name, spec in _OPTIONAL.items() if name in arrays
        }
        camera = str(arrays.get("camera", PERSPECTIVE.name))
        if camera not in CAMERAS:
            raise InputError(f"{path}: 'camera' is '{camera}', expected one of {', '.join(CAMERAS)}")
        return Reconstruction(**known, **optional, image_names=names, camera=CAMERAS[camera])


# Shape by symbol (numbers are literal) and kind of every field of the file.
_LAYOUT: dict[str, tuple[tuple[str | int, ...], type]] = {
    "pixels": (("F", "P", 2), float),
    "K": (("F", 3, 3), float),
    "visible": (("F", "P"), bool),
    "points": (("F", "P", 3), float),
    "normals": (("F", "P", 3), float),
    "depth": (("F", "P"), float),
    "first_order": (("F", "P", 2), float),
    "second_order": (("F", "P", 3), float),
    "edges": (("E", 2), int),
    "edge_weight": (("E",), float),
    "conformal_scale": (("E", "P"), float),
    "depth_std": (("F", "P"), float),
    "log_factor": (("F", "P"), float),
    "interpolated": (("F", "P"), bool),
    "outlier": (("F", "P"), bool),
}
_OPTIONAL: dict[str, tuple[tuple[str | int, ...], type]] = {
    "ambiguous": (("F",), int),
    "alternative": (("F", "P", 3), float),
}
_KINDS = {float: ("fiu", "numbers"), int: ("iu", "whole numbers"), bool: ("b", "true and false")}


def _checked(
    arrays: Mapping[str, np.ndarray],
    name: str,
    spec: tuple[tuple[str | int, ...], type],
    sizes: dict[str, int],
    source: str,
) -> np.ndarray:
    """The array of a field after its shape and type were checked; `sizes` learns F, P and E on the way."""
    shape, kind = spec
    if name not in arrays:
        raise InputError(f"{source}: field '{name}' is missing; expected a {RESULT_FILE} written by 'reconstruct'")
    array = arrays[name]
    fits = array.ndim == len(shape)
    for size, symbol in zip(array.shape, shape, strict=False):
        fits &= size == (symbol if isinstance(symbol, int) else sizes.setdefault(symbol, size))
    if not fits:
        wanted = ", ".join(str(sizes.get(str(symbol), symbol)) for symbol in shape)
        raise InputError(f"{source}: '{name}' has shape {array.shape}, expected ({wanted})")
    if array.dtype.kind not in _KINDS[kind][0]:
        raise InputError(f"{source}: '{name}' holds {array.dtype} values, expected {_KINDS[kind][1]}")
    return array.astype(kind, copy=False)


@dataclass(frozen=True)
class RunRecord:
    """How a reconstruction came about, enough to repeat it and to judge it."""

    source: str
    """The tracks' file or how they were made."""
    method: str
    """Name in the registry of methods."""
    seed: int
    """Seed of every random choice."""
    configuration: dict[str, Any] = field(default_factory=dict)
    """The resolved configuration, nested by stage."""
    decisions: dict[str, Any] = field(default_factory=dict)
    """What was chosen from the data (noise levels, smoothing, model), by name."""
    warnings: tuple[str, ...] = ()
    """One sentence each, for the user."""
    cost_history: dict[str, list[float]] = field(default_factory=dict)
    """Cost after each iteration, by stage."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock seconds of each stage."""
    peak_memory_mib: float = 0.0
    """Largest resident memory of the run's processes, added up, in MiB."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of Python and of the packages that compute."""

    def save(self, path: str | Path) -> None:
        """Write `run.json`; numbers JSON cannot express (NaN, infinity) become null."""
        text = json.dumps(_plain(asdict(self)), indent=2, allow_nan=False)
        with written_beside(path) as part:
            part.write_text(text + "\n", encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> RunRecord:
        """Read `run.json`, or the folder that holds it; keys this version does not know are ignored.

        Raises:
            InputError: the file cannot be read, lacks a key or holds something of the wrong type.
        """
        path = Path(path)
        path = path / RECORD_FILE if path.is_dir() else path
        require_file(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise InputError(f"{path}: not a JSON file (truncated or of another format)") from error
        if not isinstance(content, dict):
            raise InputError(f"{path}: holds no JSON object; expected a {RECORD_FILE} written by 'reconstruct'")
        for name in ("source", "method", "seed"):
            if name not in content:
                raise InputError(f"{path}: key '{name}' is missing; expected a {RECORD_FILE} written by 'reconstruct'")
        known = {item.name: content[item.name] for item in fields(RunRecord) if item.name in content}
        for name, value in known.items():
            fits, expected = _RECORD[name]
            if not fits(value):
                raise InputError(
                    f"{path}: '{name}' is not {expected}; expected a {RECORD_FILE} written by 'reconstruct'"
                )
        record = RunRecord(**{**known, "warnings": tuple(known.get("warnings", ()))})
        return replace(
            record,
            cost_history={stage: [_number(cost) for cost in costs] for stage, costs in record.cost_history.items()},
            seconds={stage: _number(value) for stage, value in record.seconds.items()},
            peak_memory_mib=_number(record.peak_memory_mib),
        )


def _number(value: float | None) -> float:
    """A figure as it stands in JSON, where null says that it is none."""
    return float("nan") if value is None else float(value)


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


# What the keys of the record must hold, and how to say it.
_RECORD: dict[str, tuple[Callable[[Any], bool], str]] = {
    "source": (_is_text, "a text"),
    "method": (_is_text, "a text"),
    "seed": (lambda value: isinstance(value, int) and not isinstance(value, bool), "a whole number"),
    "configuration": (_is_table, "a table of settings"),
    "decisions": (_is_table, "a table of decisions"),
    "warnings": (lambda value: isinstance(value, list) and all(map(_is_text, value)), "a list of sentences"),
    "cost_history": (
        lambda value: (
            isinstance(value, dict)
            and all(isinstance(costs, list) and all(map(_is_number, costs)) for costs in value.values())
        ),
        "a table of lists of numbers",
    ),
    "seconds": (lambda value: isinstance(value, dict) and all(map(_is_number, value.values())), "a table of numbers"),
    "peak_memory_mib": (_is_number, "a number"),
    "versions": (lambda value: isinstance(value, dict) and all(map(_is_text, value.values())), "a table of texts"),
}


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that compute."""
    names = ("connrsfm-graph", "gtsam", "numpy", "scipy", "numba", "networkx", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, in MiB; NaN on systems that do not tell."""
    if sys.platform == "win32":
        return float("nan")
    with suppress(OSError):
        # On Linux `getrusage` also counts what the process was before it became this program.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        if (match := re.search(r"VmHWM:\s*(\d+) kB", status)) is not None:
            return int(match[1]) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _plain(value: Any) -> Any:
    """The same value in types that JSON knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
