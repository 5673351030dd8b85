"""What a view of one image draws: a mesh, dense where there is one, with the numbers that colour it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from connrsfm_graph.dense.layout import DENSE_FOLDER, INDEX_FILE, DenseFrame, DenseIndex, read_depth
from connrsfm_graph.export.mesh import mesh_of_depth
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.colour import DEPTH, ERROR, SCALE, Ramp
from connrsfm_graph.report.surfaces import Surfaces
from connrsfm_graph.tracks.images import read_image


@dataclass(frozen=True)
class Paint:
    """One way to colour a surface by numbers."""

    name: str
    """What the reader chooses."""
    ramp: Ramp
    """Colours from the lower to the upper end."""
    lower: float
    upper: float
    """Ends of the colours, common to all images."""
    ends: tuple[str, str]
    """What stands beside them."""
    unit: str
    """What the numbers are."""


@dataclass(frozen=True)
class ShownMesh:
    """The surface of one image."""

    points: np.ndarray
    """(V, 3) in camera frame, aligned to the truth where known; all finite."""
    pixels: np.ndarray
    """(V, 2) where in the image they are seen."""
    triangles: np.ndarray
    """(T, 3)."""
    values: dict[str, np.ndarray]
    """(V,) numbers by paint's name, NaN where unknown."""


def paints(surfaces: Surfaces) -> list[Paint]:
    """The ways in which this result can be coloured by numbers."""
    lower, upper = surfaces.relief_range()
    unit = "" if surfaces.truth is None else ", unit of the truth"
    found = [
        Paint(
            "depth", DEPTH, lower, upper, (f"{lower:+.3g}", f"{upper:+.3g}"), f"depth from the surface's middle{unit}"
        )
    ]
    if surfaces.error is not None:
        lower, upper = surfaces.error_range()
        found.append(
            Paint("error", ERROR, lower, upper, ("0", f"{upper:.2g}"), "distance to the truth, % of its extent")
        )
    if np.isfinite(surfaces.log_scale).any():
        lower, upper = surfaces.scale_range()
        ends = (f"{100 * np.expm1(lower):+.2g}", f"{100 * np.expm1(upper):+.2g}")
        found.append(Paint("conformal scale", SCALE, lower, upper, ends, "% larger than on average over the images"))
    return found


@dataclass(frozen=True)
class DenseSurfaces:
    """The folder of `connrsfm densify`, where a result has one."""

    folder: Path
    frames: dict[int, DenseFrame]
    """By the image's number."""

    @staticmethod
    def beside(out: Path) -> DenseSurfaces | None:
        """Those of a result's folder, None where there are none.

        Raises:
            InputError: the folder's index is damaged.
        """
        folder = out / DENSE_FOLDER
        if not (folder / INDEX_FILE).exists():
            return None
        return DenseSurfaces(folder, {frame.frame: frame for frame in DenseIndex.load(folder).frames})

    def images(self, n_frames: int) -> Iterator[np.ndarray]:
        """The images (H, W, 3) uint8 RGB that the surfaces were textured with, black where one has no surface."""
        width, height = DenseIndex.load(self.folder).size
        for f in range(n_frames):
            found = f in self.frames
            yield read_image(self.folder / self.frames[f].texture) if found else np.zeros((height, width, 3), np.uint8)


def shown_mesh(
    reconstruction: Reconstruction, surfaces: Surfaces, dense: DenseSurfaces | None, f: int, most: int
) -> ShownMesh:
    """The mesh of an image: its dense surface with about `most` vertices, or the triangles between its points."""
    K = reconstruction.K[f]
    known = np.isfinite(reconstruction.points[f]).all(axis=1)
    pixels = reconstruction.camera.image(reconstruction.points[f, known]) @ K[:2, :2].T + K[:2, 2]
    values = {"depth": surfaces.relief[f, known], "conformal scale": surfaces.log_scale[f, known]}
    if surfaces.error is not None:
        values["error"] = surfaces.error[f, known]
    if dense is None or f not in dense.frames:
        number = np.cumsum(known) - 1
        return ShownMesh(surfaces.points[f, known], pixels, number[surfaces.triangles[f]], values)
    depth = read_depth(dense.folder, dense.frames[f])
    mesh = mesh_of_depth(depth, K, max(1, round(np.sqrt(np.isfinite(depth).sum() / most))))
    s, R, t = surfaces.to_truth[f]
    points = s * mesh.points @ R.T + t
    places = mesh.uv * depth.shape[::-1] - 0.5
    interpolated = {name: _interpolated(pixels, value, places) for name, value in values.items()}
    interpolated["depth"] = points[:, 2] - surfaces.centre[f, 2]
    return ShownMesh(points, places, mesh.triangles, interpolated)


def _interpolated(pixels: np.ndarray, values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(V,) values between those known of points (P, 2), linear; NaN outside of them."""
    known = np.isfinite(values)
    if known.sum() < 4:
        return np.full(len(places), np.nan)
    return np.asarray(LinearNDInterpolator(pixels[known], values[known])(places))
