"""Meshes of depth maps, and what an independent reader finds in the files."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.export.glb import jpeg_of, write_glb, write_glb_sequence
from connrsfm_graph.export.mesh import TexturedMesh, mesh_of_depth
from connrsfm_graph.export.ply import write_ply

K = np.array([[100.0, 0.0, 32.0], [0.0, 90.0, 24.0], [0.0, 0.0, 1.0]])


def _depth() -> np.ndarray:
    """A tilted plane over a disc with a hole."""
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    r = np.hypot(x - 32, y - 24)
    return np.where((r < 20) & (r > 6), 2.0 / (1.0 - 0.004 * (x - 32)), np.nan)


@pytest.fixture
def mesh() -> TexturedMesh:
    return mesh_of_depth(_depth(), K, step=3)


def _image() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 255, 64), np.linspace(0, 255, 48))
    return np.stack([x, y, np.full_like(x, 90)], axis=-1).astype(np.uint8)


def test_vertices_lie_on_the_surface_and_project_to_their_place(mesh: TexturedMesh) -> None:
    projected = mesh.points @ K.T
    pixels = mesh.uv * (64, 48) - 0.5
    assert projected[:, :2] / projected[:, 2:] == pytest.approx(pixels, abs=1e-9)
    # z = 2 + 0.4 x is the plane.
    assert mesh.points[:, 2] == pytest.approx(2.0 + 0.4 * mesh.points[:, 0], abs=1e-9)
    towards = np.array([0.4, 0.0, -1.0]) / np.hypot(0.4, 1.0)
    assert mesh.normals == pytest.approx(np.tile(towards, (len(mesh.points), 1)), abs=1e-6)


def test_the_mesh_follows_border_and_hole(mesh: TexturedMesh) -> None:
    corners = (mesh.uv * (64, 48) - 0.5)[mesh.triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert (area > 0).all()
    assert area.sum() == pytest.approx(np.isfinite(_depth()).sum(), rel=0.06)
    radius = np.linalg.norm(corners.mean(axis=1) - (32, 24), axis=1)
    assert radius.min() > 5.5
    assert radius.max() < 20
    assert (np.linalg.norm(corners.reshape(-1, 2) - (32, 24), axis=1) > 19).sum() > 60, "vertices on the outer border"


def test_no_depth_is_no_mesh() -> None:
    assert len(mesh_of_depth(np.full((9, 9), np.nan), K).triangles) == 0


def test_glb_opens_in_trimesh_with_its_texture(mesh: TexturedMesh, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_glb(tmp_path / "a.glb", mesh, jpeg_of(_image()), "sheet")
    (read,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert len(read.faces) == len(mesh.triangles)
    # glTF: y up, z towards the viewer.
    assert np.asarray(read.vertices) == pytest.approx(mesh.points * [1, -1, -1], abs=1e-5)
    assert (np.asarray(read.face_normals) @ [0, 0, 1] > 0).all(), "front faces look at the viewer"
    texture = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert np.abs(texture - _image()).max() < 30
    # trimesh turns v upside down.
    assert read.visual.uv == pytest.approx(np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1), abs=1e-6)


def test_glb_is_laid_out_as_the_format_demands(mesh: TexturedMesh, tmp_path: Path) -> None:
    meshes, jpegs = [mesh] * 3, [jpeg_of(_image())] * 3
    write_glb_sequence(tmp_path / "s.glb", meshes, jpegs, ["a", "b", "c"], seconds=0.5)
    data = (tmp_path / "s.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    content = json.loads(data[20 : 20 + size])
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (binary_kind, size % 4, binary_size % 4) == (b"BIN\0", 0, 0)
    assert content["buffers"] == [{"byteLength": binary_size}]
    binary = data[28 + size :]
    for accessor in content["accessors"]:
        view = content["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == 4 * width * accessor["count"]
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
    image = content["bufferViews"][content["images"][1]["bufferView"]]
    assert binary[image["byteOffset"] : image["byteOffset"] + image["byteLength"]] == jpegs[1]
    shown = []
    for channel in content["animations"][0]["channels"]:
        sampler = content["animations"][0]["samplers"][channel["sampler"]]
        view = content["bufferViews"][content["accessors"][sampler["output"]]["bufferView"]]
        scales = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(-1, 3)
        shown.append(scales[:3, 0])
    assert np.array(shown) == pytest.approx(np.eye(3)), "one mesh at a time"
    assert [node["scale"][0] for node in content["nodes"]] == [1.0, 0.0, 0.0]


def test_ply_opens_in_trimesh_with_its_colours(mesh: TexturedMesh, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_ply(tmp_path / "a.ply", mesh, _image())
    read = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.asarray(read.vertices) == pytest.approx(mesh.points, abs=1e-5)
    assert (np.asarray(read.faces) == mesh.triangles).all()
    x, y = np.round(mesh.uv * (64, 48) - 0.5).astype(int).T
    assert (np.asarray(read.visual.vertex_colors)[:, :3] == _image()[y, x]).all()


def test_textures_shrink_to_the_longest_side() -> None:
    cv2 = pytest.importorskip("cv2")
    small = cv2.imdecode(np.frombuffer(jpeg_of(_image(), longest=32), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (24, 32, 3)
