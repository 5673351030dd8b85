"""The folder that `connrsfm densify DIR` leaves in DIR/dense, for people, other programs and the report page.

    index.json           what was made and how, below
    depth/000.npy        (H, W) float32: depth along z of every pixel in the reconstruction's unit, NaN off the surface
    depth/000.png        the same as 16-bit PNG: round(depth * depth_png_scale), 0 off the surface
    texture/000.jpg      the image
    glb/000.glb          the textured surface (glTF axes: x right, y up, z towards the viewer)
    ply/000.ply          the surface with a colour per vertex (camera axes: x right, y down, z forward)
    sequence.glb         all surfaces as one animation

Files are named by the image's number in the reconstruction; images without a surface have none and stand in `skipped`.
`index.json` is one object:

    format               1
    method, reason       "network" or "spline", and why it was chosen
    checkpoint           the network's checkpoint, null for the spline
    size                 [W, H] pixels
    depth_png_scale      steps of the 16-bit PNGs per unit of depth
    sequence             name of the animation
    frames               one object per image with a surface: frame (its number), name, K (3 x 3), points (tracks used),
                         covered (part of the pixels), depth_range [nearest, farthest], residual_percent (root mean
                         square difference of the dense surface to the sparse points, relative to depth), seconds, and
                         the names of its files: depth, depth_png, texture, glb, ply
    skipped              one object per image without: frame, name, reason
    warnings             sentences for the user

A pixel (x, y) with depth z is the point z K^-1 (x, y, 1) of the camera frame; `export.mesh.mesh_of_depth` makes meshes
of any resolution from a depth map.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file, written_beside

DENSE_FOLDER = "dense"
INDEX_FILE = "index.json"
SEQUENCE_FILE = "sequence.glb"
FORMAT = 1


@dataclass(frozen=True)
class DenseFrame:
    """What the index says of one image with a surface; file names are relative to the folder."""

    frame: int
    """Number of the image in the reconstruction."""
    name: str
    """Name of the image."""
    K: list[list[float]]
    """3 x 3 intrinsics."""
    points: int
    """Sparse points that the surface was made from."""
    covered: float
    """Part of the pixels that have a depth."""
    depth_range: list[float]
    """Smallest and largest depth."""
    residual_percent: float
    """Root mean square difference of dense and sparse depth at the sparse points, in percent of depth."""
    seconds: float
    """Time for the depth map, its mesh and its texture, files and this image's share of the fit included."""
    depth: str
    depth_png: str
    texture: str
    glb: str
    ply: str


@dataclass(frozen=True)
class DenseIndex:
    """Content of `index.json`; the module's docstring explains the fields."""

    method: str
    reason: str
    checkpoint: str | None
    size: list[int]
    depth_png_scale: float
    sequence: str
    frames: list[DenseFrame]
    skipped: list[dict[str, Any]]
    warnings: list[str]
    format: int = FORMAT

    def save(self, folder: str | Path) -> None:
        """Write the index into a folder of dense surfaces."""
        with written_beside(Path(folder) / INDEX_FILE) as part:
            part.write_text(json.dumps(asdict(self), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @staticmethod
    def load(folder: str | Path) -> DenseIndex:
        """Read the index of a folder written by `densify`.

        Raises:
            InputError: no index, not JSON, of another format, or a field is missing.
        """
        path = Path(folder) / INDEX_FILE
        require_file(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise InputError(f"{path}: has format {content['format']}, this version reads format {FORMAT}")
            frames = [DenseFrame(**frame) for frame in content.pop("frames")]
            return DenseIndex(**content, frames=frames)
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged, or not written by 'densify'") from error


def read_depth(folder: str | Path, frame: DenseFrame) -> np.ndarray:
    """Depth map (H, W) of an image of the index, NaN off the surface.

    Raises:
        InputError: the file is missing or holds no such array.
    """
    path = Path(folder) / frame.depth
    require_file(path)
    try:
        depth = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as an array") from error
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise InputError(f"{path}: has shape {depth.shape} and type {depth.dtype}, expected a depth map (H, W)")
    return depth
