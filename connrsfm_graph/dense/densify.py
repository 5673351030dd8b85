"""Dense textured surfaces of all images of a reconstruction, written into a folder (see `dense.layout`)."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from connrsfm_graph.dense.choose import DepthMethod, choose
from connrsfm_graph.dense.layout import DENSE_FOLDER, SEQUENCE_FILE, DenseFrame, DenseIndex
from connrsfm_graph.dense.region import surface_region
from connrsfm_graph.dense.sparse import SparsePoints
from connrsfm_graph.errors import InputError
from connrsfm_graph.export.depth_png import png_scale, write_depth_png
from connrsfm_graph.export.glb import jpeg_of, write_glb, write_glb_sequence
from connrsfm_graph.export.mesh import TexturedMesh, default_step, mesh_of_depth
from connrsfm_graph.export.ply import write_ply
from connrsfm_graph.files import folder_written_beside
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.mesh import triangles
from connrsfm_graph.tracks.images import Source, images_of

FEWEST_POINTS = 10
"""Images with fewer sparse points have no dense surface."""
NARROWEST = 4.0
"""Pixels that the points of an image with a dense surface span along either axis."""
SEQUENCE_CELLS = 80
"""Cells along the longer side of a surface of the animation."""
SEQUENCE_TEXTURE = 512
"""Longest side of an image of the animation."""
SECONDS_PER_IMAGE = 0.2
"""For how long the animation shows each image."""
_CENTRE = (0.3, 0.7)


def densify(
    reconstruction: Reconstruction,
    images: Source,
    out: str | Path,
    method: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DenseIndex:
    """Make the dense surface of every image and write OUT/dense.

    Args:
        reconstruction: sparse surfaces.
        images: the images that were tracked, as a folder, a list of files or a video; more may be there where the
            reconstruction knows their names.
        out: folder of the result.
        method, checkpoint: see `dense.choose`.
        progress: called with (images done, images).

    Raises:
        InputError: the camera was orthographic; images that are not those of the tracks, cannot be read or are of
            different sizes; no image with enough points; and those of `dense.choose`.
    """
    if not reconstruction.camera.kappa:
        raise InputError("the reconstruction is of an orthographic camera, dense surfaces need a perspective one")
    sparse = [SparsePoints.of(reconstruction, f) for f in range(reconstruction.n_frames)]
    problems = [_problem(points) for points in sparse]
    usable = [f for f, problem in enumerate(problems) if problem is None]
    if not usable:
        raise InputError(f"no image has a dense surface; {reconstruction.frame_name(0)} has {problems[0]}")
    start = time.perf_counter()
    choice = choose([sparse[f] for f in usable], method, checkpoint)
    fitting = (time.perf_counter() - start) / len(usable)
    scale = png_scale(1.5 * max(float(sparse[f].depth.max()) for f in usable))
    with folder_written_beside(out) as part:
        folder = part / DENSE_FOLDER
        writer = _Writer(folder, scale, fitting)
        skipped, warnings = [], list(choice.warnings)
        size = (0, 0)
        for f, image in enumerate(images_of(images, reconstruction.image_names, reconstruction.n_frames)):
            points, name = sparse[f], reconstruction.frame_name(f)
            if f == 0:
                size = image.shape[1], image.shape[0]
                warnings += _camera_warnings(points.K, size)
            _check_inside(reconstruction, f, size, images)
            problem = problems[f]
            if problem is None:
                writer.add(f, name, points, choice.method, usable.index(f), image)
            else:
                skipped.append({"frame": f, "name": name, "reason": problem})
            if progress is not None:
                progress(f + 1, reconstruction.n_frames)
        writer.write_sequence()
        index = DenseIndex(
            method=choice.method.name,
            reason=choice.reason,
            checkpoint=choice.checkpoint,
            size=list(size),
            depth_png_scale=scale,
            sequence=SEQUENCE_FILE,
            frames=writer.frames,
            skipped=skipped,
            warnings=warnings,
        )
        index.save(folder)
    return index


class _Writer:
    """Writes the surfaces of one image after the other, and keeps what the index and the animation need of them."""

    def __init__(self, folder: Path, scale: float, fitting: float) -> None:
        self.folder = folder
        self.scale = scale
        self.fitting = fitting
        """Seconds per image that the choice and the fit of the method took."""
        self.frames: list[DenseFrame] = []
        self._coarse: list[tuple[TexturedMesh, bytes]] = []

    def add(self, f: int, name: str, points: SparsePoints, method: DepthMethod, number: int, image: np.ndarray) -> None:
        """Make and write the surface of image `f`, the method's image `number`."""
        start = time.perf_counter()
        size = image.shape[1], image.shape[0]
        depth = np.where(surface_region(points.pixels, size), method.depth(number, size), np.nan)
        mesh = mesh_of_depth(depth, points.K)
        residual = method.depth_at(number, points.pixels) / points.depth - 1.0
        files = self._write(f, name, depth, mesh, image)
        self.frames.append(
            DenseFrame(
                frame=f,
                name=name,
                K=points.K.tolist(),
                points=len(points),
                covered=float(np.isfinite(depth).mean()),
                depth_range=[float(np.nanmin(depth)), float(np.nanmax(depth))],
                residual_percent=100.0 * float(np.sqrt((residual**2).mean())),
                seconds=self.fitting + time.perf_counter() - start,
                **files,
            )
        )
        coarse = mesh_of_depth(depth, points.K, default_step(depth, SEQUENCE_CELLS))
        self._coarse.append((coarse, jpeg_of(image, SEQUENCE_TEXTURE)))

    def write_sequence(self) -> None:
        """Write the animation of all surfaces so far."""
        meshes, jpegs = zip(*self._coarse, strict=True)
        names = [frame.name for frame in self.frames]
        write_glb_sequence(self.folder / SEQUENCE_FILE, meshes, jpegs, names, SECONDS_PER_IMAGE)

    def _write(self, f: int, name: str, depth: np.ndarray, mesh: TexturedMesh, image: np.ndarray) -> dict[str, str]:
        """Write the files of one image; their names by kind."""
        files = {
            "depth": f"depth/{f:03d}.npy",
            "depth_png": f"depth/{f:03d}.png",
            "texture": f"texture/{f:03d}.jpg",
            "glb": f"glb/{f:03d}.glb",
            "ply": f"ply/{f:03d}.ply",
        }
        for file in files.values():
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
        jpeg = jpeg_of(image)
        np.save(self.folder / files["depth"], depth.astype(np.float32))
        write_depth_png(self.folder / files["depth_png"], depth, self.scale)
        (self.folder / files["texture"]).write_bytes(jpeg)
        write_glb(self.folder / files["glb"], mesh, jpeg, name)
        write_ply(self.folder / files["ply"], mesh, image)
        return files


def _problem(points: SparsePoints) -> str | None:
    """What an image lacks for a dense surface, None where nothing."""
    if len(points) < FEWEST_POINTS:
        return f"{len(points)} recovered points, a surface needs {FEWEST_POINTS}"
    if np.ptp(points.pixels, axis=0).min() < NARROWEST or not len(triangles(points.pixels)):
        return "points on a line"
    return None


def _check_inside(reconstruction: Reconstruction, f: int, size: tuple[int, int], source: Source) -> None:
    """Raise `InputError` where tracks lie outside of an image of `size`."""
    seen = reconstruction.pixels[f, reconstruction.visible[f]]
    if len(seen) and ((seen < -0.5) | (seen > np.array(size) - 0.5)).any():
        x, y = seen.max(axis=0)
        raise InputError(
            f"{source}: images have {size[0]} x {size[1]} pixels but tracks of {reconstruction.frame_name(f)} reach "
            f"x = {x:.0f}, y = {y:.0f}; expected the images that were tracked, at their size"
        )


def _camera_warnings(K: np.ndarray, size: tuple[int, int]) -> list[str]:
    """A sentence where the camera's axis is so far from the middle that the images may be larger than those tracked."""
    middle = K[:2, 2] / np.array(size)
    if ((middle > _CENTRE[0]) & (middle < _CENTRE[1])).all():
        return []
    return [
        f"the camera's axis meets the image at {middle[0]:.0%} of its width and {middle[1]:.0%} of its height: check "
        "that the images have the size that was tracked"
    ]
