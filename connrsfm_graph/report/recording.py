"""The result as a recording for the viewer rerun (extra `viz`), one step of its timeline per image."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError, missing_package
from connrsfm_graph.files import written_beside
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.colour import point_colours, ramp_colours
from connrsfm_graph.report.photos import photos_of
from connrsfm_graph.report.pictures import typical_place
from connrsfm_graph.report.shown import DenseSurfaces, paints, shown_mesh
from connrsfm_graph.report.surfaces import Surfaces

APPLICATION = "connrsfm"
TIMELINE = "image"
_VERTICES = 20_000
_TEXTURE = 1024
"""Longest side of a texture in pixels."""


def write_recording(
    path: str | Path,
    out: str | Path,
    reconstruction: Reconstruction,
    truth: np.ndarray | None = None,
    images: Iterable[np.ndarray] | None = None,
) -> Path:
    """Write an `.rrd` file that `rerun FILE` opens.

    Entities: `surface` is the mesh with the image as texture where images are, else with a depth colour; `points` the
    recovered points, one colour per point in all images; `truth` the true ones; `photo` the part of the image that
    shows the object. Camera axes: x right, y down, z forward.

    Args:
        path: the file.
        out: folder of the result, with dense surfaces or without.
        reconstruction: what is recorded.
        truth: (F, P, 3) true points in camera frames, NaN where unknown.
        images: F images (H, W, 3) uint8 RGB; those of the dense surfaces where None.

    Raises:
        InputError: rerun is not installed, or `path` does not end in .rrd.
    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise InputError(f"--rerun {path}: expected a name that ends in .rrd")
    try:
        import rerun as rr
    except ImportError as error:
        raise missing_package("--rerun", "rerun", "viz") from error
    surfaces = Surfaces.of(reconstruction, truth)
    dense = DenseSurfaces.beside(Path(out))
    if images is None and dense is not None:
        images = dense.images(reconstruction.n_frames)
    photos = None if images is None else photos_of(images, reconstruction.pixels, longest=_TEXTURE)
    identity = point_colours(typical_place(reconstruction))
    depth = paints(surfaces)[0]
    with written_beside(path) as part:
        recording = rr.RecordingStream(APPLICATION)
        recording.save(part)
        recording.log("/", rr.ViewCoordinates.RDF, static=True)
        for f in surfaces.frames:
            recording.set_time(TIMELINE, sequence=f)
            mesh = shown_mesh(reconstruction, surfaces, dense, f, _VERTICES)
            look: dict[str, Any] = {
                "vertex_colors": ramp_colours(depth.ramp, mesh.values[depth.name], depth.lower, depth.upper)
            }
            if photos is not None:
                image = photos[f].image
                places = (photos[f].place(mesh.pixels) + 0.5) / image.shape[1::-1]
                look = {"vertex_texcoords": places, "albedo_texture": image}
                recording.log("photo", rr.Image(image))
            recording.log("surface", rr.Mesh3D(vertex_positions=mesh.points, triangle_indices=mesh.triangles, **look))
            shown = {"points": surfaces.points[f]} | ({} if surfaces.truth is None else {"truth": surfaces.truth[f]})
            for name, points in shown.items():
                known = np.isfinite(points).all(axis=1)
                recording.log(name, rr.Points3D(points[known], colors=identity[known]))
        recording.flush()
        recording.disconnect()
    return path
