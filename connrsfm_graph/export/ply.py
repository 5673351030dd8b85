"""PLY: a mesh with normals and colours at its vertices, binary and little-endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from connrsfm_graph.export.mesh import TexturedMesh
from connrsfm_graph.files import written_beside

_VERTEX = np.dtype([("point", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("corners", "u1"), ("vertex", "<i4", 3)])


def write_ply(path: str | Path, mesh: TexturedMesh, image: np.ndarray) -> None:
    """Write a mesh in its camera frame, coloured by the pixels of `image` (H, W, 3), uint8, red, green, blue."""
    height, width = image.shape[:2]
    vertices = np.empty(len(mesh.points), _VERTEX)
    vertices["point"], vertices["normal"] = mesh.points, mesh.normals
    x, y = np.floor(mesh.uv * (width, height)).astype(int).clip(0, (width - 1, height - 1)).T
    vertices["colour"] = image[y, x]
    faces = np.empty(len(mesh.triangles), _FACE)
    faces["corners"], faces["vertex"] = 3, mesh.triangles
    floats = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{floats}{colours}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with written_beside(path) as part:
        part.write_bytes(header.encode("ascii") + vertices.tobytes() + faces.tobytes())
