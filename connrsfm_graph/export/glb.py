"""Textured meshes as binary glTF 2.0 (GLB), the 3D format that browsers, Blender and most viewers open.

glTF's axes are x right, y up, z towards the viewer: camera frames (x right, y down, z forward) are turned by half a
turn about x. Materials are unlit, since a photograph holds its light already. A sequence is one file with a node per
image and an animation that shows them one after the other by their scale, 1 or 0; a viewer that plays no animation
shows the first.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from connrsfm_graph.export.mesh import TexturedMesh
from connrsfm_graph.files import written_beside

_FLOAT, _UNSIGNED = 5126, 5125
_TO_GLTF = np.array([1.0, -1.0, -1.0])
_SHOWN, _HIDDEN = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def write_glb(path: str | Path, mesh: TexturedMesh, jpeg: bytes, name: str = "surface") -> None:
    """Write one mesh with its image, a JPEG file's content."""
    scene = _Scene()
    scene.add(mesh, jpeg, name)
    scene.write(path)


def write_glb_sequence(
    path: str | Path, meshes: Sequence[TexturedMesh], jpegs: Sequence[bytes], names: Sequence[str], seconds: float
) -> None:
    """Write an animation that shows every mesh for `seconds`."""
    scene = _Scene()
    for number, (mesh, jpeg, name) in enumerate(zip(meshes, jpegs, names, strict=True)):
        scene.add(mesh, jpeg, name, scale=_HIDDEN if number else _SHOWN)
    scene.animate(seconds)
    scene.write(path)


def jpeg_of(image: np.ndarray, longest: int | None = None, quality: int = 90) -> bytes:
    """An image (H, W, 3), uint8, red, green, blue, as a JPEG file's content, no side longer than `longest` pixels."""
    scale = 1.0 if longest is None else min(1.0, longest / max(image.shape[:2]))
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    swapped = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", swapped, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


class _Scene:
    """The JSON and the binary part of a file, filled mesh by mesh."""

    def __init__(self) -> None:
        self._binary = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "connrsfm-graph"},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": []}],
            # Photographs must not wrap round at their borders (33071: clamp to edge).
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            **{kind: [] for kind in ("nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews")},
        }

    def add(self, mesh: TexturedMesh, jpeg: bytes, name: str, scale: tuple[float, ...] = _SHOWN) -> None:
        """Append a node with a mesh, its material and its image."""
        points = (mesh.points * _TO_GLTF).astype("<f4")
        attributes = {
            "POSITION": self._accessor(points, _FLOAT, "VEC3", bounded=True),
            "NORMAL": self._accessor((mesh.normals * _TO_GLTF).astype("<f4"), _FLOAT, "VEC3"),
            "TEXCOORD_0": self._accessor(mesh.uv.astype("<f4"), _FLOAT, "VEC2"),
        }
        indices = self._accessor(mesh.triangles.astype("<u4").reshape(-1), _UNSIGNED, "SCALAR")
        image = self._append("images", {"bufferView": self._view(jpeg), "mimeType": "image/jpeg"})
        texture = self._append("textures", {"source": image, "sampler": 0})
        material = self._append(
            "materials",
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": texture},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            },
        )
        primitive = {"attributes": attributes, "indices": indices, "material": material}
        number = self._append("meshes", {"name": name, "primitives": [primitive]})
        node = self._append("nodes", {"name": name, "mesh": number, "scale": scale})
        self._json["scenes"][0]["nodes"].append(node)

    def animate(self, seconds: float) -> None:
        """Show the nodes one after the other, each for `seconds`."""
        count = len(self._json["nodes"])
        times = self._accessor((np.arange(count + 1) * seconds).astype("<f4"), _FLOAT, "SCALAR", bounded=True)
        samplers, channels = [], []
        for node in range(count):
            scales = np.zeros((count + 1, 3), "<f4")
            scales[node] = 1.0
            scales[-1] = scales[-2]
            output = self._accessor(scales, _FLOAT, "VEC3")
            channels.append({"sampler": node, "target": {"node": node, "path": "scale"}})
            samplers.append({"input": times, "output": output, "interpolation": "STEP"})
        self._json["animations"] = [{"name": "sequence", "samplers": samplers, "channels": channels}]

    def write(self, path: str | Path) -> None:
        """Write the file: a header, the JSON and the binary part, each padded to four bytes."""
        self._json["buffers"] = [{"byteLength": len(self._binary)}]
        text = json.dumps(self._json, separators=(",", ":"), allow_nan=False).encode("utf-8")
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._binary), b"BIN\0") + self._binary
        with written_beside(path) as part:
            part.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

    def _append(self, kind: str, item: dict[str, Any]) -> int:
        self._json[kind].append(item)
        return len(self._json[kind]) - 1

    def _view(self, content: bytes) -> int:
        """Append bytes to the binary part, padded so that whatever follows is aligned."""
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        self._binary += content + bytes(-len(content) % 4)
        return self._append("bufferViews", view)

    def _accessor(self, array: np.ndarray, component: int, kind: str, bounded: bool = False) -> int:
        item: dict[str, Any] = {
            "bufferView": self._view(array.tobytes()),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if bounded:
            rows = array.reshape(len(array), -1)
            item |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._append("accessors", item)
