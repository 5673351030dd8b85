"""Large pictures of the surfaces for papers and talks: every image from one side, in every colouring, as PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from connrsfm_graph.files import folder_written_beside
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.colour import ramp_colours
from connrsfm_graph.report.photos import photos_of
from connrsfm_graph.report.pictures import Picture
from connrsfm_graph.report.raster import Raster, View, turned
from connrsfm_graph.report.shown import DenseSurfaces, paints, shown_mesh
from connrsfm_graph.report.surfaces import Surfaces

RENDERS_FOLDER = "renders"
FROM = (30.0, 18.0)
"""Degrees to the right and up from which surfaces are seen, as at first in the page's view."""
_VERTICES = 12_000
"""Of a dense surface."""
_FILLED = 0.96
"""Share of the picture's width or height that the largest surface takes."""


def write_renders(
    out: str | Path,
    reconstruction: Reconstruction,
    width: int,
    seen_from: tuple[float, float] = FROM,
    truth: np.ndarray | None = None,
    images: Iterable[np.ndarray] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write OUT/renders/0000_image.png, 0000_depth.png, ... and return the folder.

    All have one scale and are transparent beside the surface. `image` is there where images are, `error` where the
    truth is known, `conformal-scale` where it was estimated.

    Args:
        out: folder of a result; dense surfaces that `connrsfm densify` has left there are drawn.
        reconstruction: what is drawn.
        width: of the pictures in pixels.
        seen_from: degrees to the right of the camera and above it.
        truth: (F, P, 3) true points in camera frames, NaN where unknown.
        images: F images (H, W, 3) uint8 RGB; those of the dense surfaces where None.
        progress: called with the number of images drawn and in all.

    Raises:
        InputError: the truth does not fit the reconstruction, or the dense surfaces' folder is damaged.
    """
    surfaces = Surfaces.of(reconstruction, truth)
    dense = DenseSurfaces.beside(Path(out))
    if images is None and dense is not None:
        images = dense.images(reconstruction.n_frames)
    photos = None if images is None else photos_of(images, reconstruction.pixels, longest=2 * width)
    R = turned(*seen_from)
    reach = surfaces.reach(R)
    view = View(R, 0.5 * _FILLED * width / reach[0], (width, max(1, round(width * reach[1] / reach[0]))))
    with folder_written_beside(out) as part:
        folder = part / RENDERS_FOLDER
        folder.mkdir()
        for done, f in enumerate(surfaces.frames, 1):
            mesh = shown_mesh(reconstruction, surfaces, dense, f, _VERTICES)
            raster = Raster.of(view, surfaces.centre[f], mesh.points, mesh.triangles)
            if photos is not None:
                rgba = raster.textured(photos[f].place(mesh.pixels), photos[f].image)
                (folder / f"{f:04d}_image.png").write_bytes(Picture("image", "", rgba).png())
            for way in paints(surfaces):
                colours = ramp_colours(way.ramp, mesh.values[way.name], way.lower, way.upper)
                rgba = raster.coloured(colours, lines=dense is None or f not in dense.frames)
                name = way.name.replace(" ", "-")
                (folder / f"{f:04d}_{name}.png").write_bytes(Picture(name, "", rgba).png())
            if progress is not None:
                progress(done, len(surfaces.frames))
    return Path(out) / RENDERS_FOLDER
