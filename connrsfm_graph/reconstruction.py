"""What a reconstruction yields: the surfaces (`result.npz`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz, write_npz, written_beside
from factors.surface import CAMERAS, PERSPECTIVE, Camera

RESULT_FILE = "result.npz"


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
    """(F, P) standard deviation of depth, in the same unit as depth, the scale common to all images left out; NaN where
    not estimated."""
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
