"""What is written is read back; what is broken is refused in one sentence that names file and field."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks, load_tracks, save_tracks
from connrsfm_graph.tracks.intrinsics import parse_intrinsics

K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])


def some_tracks(frames: int = 4, points: int = 9, seed: int = 0) -> Tracks:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 600, (frames, points, 2))
    visible = rng.random((frames, points)) < 0.8
    return Tracks.checked(pixels, K, visible, points=rng.uniform(1, 2, (frames, points, 3)))


def message(path: Path, *more: object) -> str:
    with pytest.raises(InputError) as caught:
        load_tracks(path, *more)
    text = str(caught.value)
    assert "\n" not in text
    return text


def same(a: Tracks, b: Tracks) -> None:
    np.testing.assert_array_equal(a.pixels, b.pixels)
    np.testing.assert_array_equal(a.K, b.K)
    np.testing.assert_array_equal(a.visible, b.visible)
    assert a.image_names == b.image_names
    for x, y in ((a.points, b.points), (a.normals, b.normals)):
        assert (x is None) == (y is None)
        if x is not None:
            np.testing.assert_array_equal(x, y)


@given(st.integers(1, 5), st.integers(1, 12), st.booleans(), st.booleans(), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_npz_round_trip(tmp_path_factory, frames: int, points: int, cameras: bool, names: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = Tracks.checked(
        rng.normal(300, 50, (frames, points, 2)),
        K * np.array([1, 1, 1])[None, :] if not cameras else np.stack([K] * frames),
        rng.random((frames, points)) < 0.7,
        normals=rng.normal(size=(frames, points, 3)),
        image_names=[f"é{k}.png" for k in range(frames)] if names else None,
    )
    path = tmp_path_factory.mktemp("npz") / "tracks.npz"
    save_tracks(path, tracks)
    same(tracks, load_tracks(path))
    assert [entry.name for entry in path.parent.iterdir()] == ["tracks.npz"]


def test_one_camera_per_image_survives(tmp_path: Path) -> None:
    cameras = np.stack([K, K, 2 * K, K])
    cameras[:, 2] = [0, 0, 1]
    tracks = Tracks.checked(np.ones((4, 2, 2)), cameras)
    save_tracks(tmp_path / "a.npz", tracks)
    np.testing.assert_array_equal(load_tracks(tmp_path / "a.npz").K, cameras)


def test_given_intrinsics_override(tmp_path: Path) -> None:
    save_tracks(tmp_path / "a.npz", some_tracks())
    assert load_tracks(tmp_path / "a.npz", "700,700,1,2").K[0, 0, 0] == 700


def test_missing_file_folder_empty_file_and_unknown_ending(tmp_path: Path) -> None:
    assert "no such file" in message(tmp_path / "none.npz")
    assert "is a folder" in message(tmp_path)
    for name in ("a.npz", "a.mat", "a.csv"):
        (tmp_path / name).touch()
        assert f"{name}: is empty" in message(tmp_path / name, "1,1,0,0")
    (tmp_path / "a.docx").write_text("x")
    assert "expected .npz, .mat or .csv" in message(tmp_path / "a.docx")
    with pytest.raises(InputError, match=r"expected \.npz"):
        save_tracks(tmp_path / "a.mat", some_tracks())


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_truncated_npz(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.npz"
    save_tracks(path, some_tracks())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "truncated" in message(path)


def test_damaged_content_of_an_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_tracks(path, some_tracks())
    content = bytearray(path.read_bytes())
    content[60:200] = bytes(140)
    path.write_bytes(bytes(content))
    assert str(path) in message(path)


def test_object_arrays_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, tracks=np.array([[1, 2], [3]], dtype=object), K=K)
    assert "'tracks' holds Python objects" in message(path)


def test_huge_declared_size(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6, 200)})
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("tracks.npy", header.getvalue())
    assert str(path) in message(path)
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("tracks.npy", "w", force_zip64=True) as f,
    ):
        for _ in range(9):
            f.write(bytes(2**20))
    from connrsfm_graph.tracks import load

    load.MAX_BYTES, limit = 2**23, load.MAX_BYTES
    try:
        assert "unpacks to" in message(path)
    finally:
        load.MAX_BYTES = limit


def test_npz_fields_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    good = {"tracks": np.ones((3, 5, 2)), "K": K}
    cases = [
        ({"K": K}, "'tracks' is missing"),
        ({"tracks": good["tracks"]}, "'K' is missing"),
        ({**good, "tracks": np.ones((3, 5))}, r"'tracks' has shape (3, 5)"),
        ({**good, "tracks": np.ones((3, 0, 2))}, "'tracks' is empty"),
        ({**good, "tracks": np.full((3, 5, 2), "x")}, "expected numbers"),
        ({**good, "K": -K}, "non-positive focal length"),
        ({**good, "K": K[:2]}, "'K' has shape (2, 3)"),
        ({**good, "K": K * np.nan}, "'K' holds NaN"),
        ({**good, "visible": np.ones((5, 3), bool)}, "'visible' has shape (5, 3), expected (3, 5)"),
        ({**good, "points": np.ones((3, 4, 3))}, "'points' has shape (3, 4, 3)"),
        ({**good, "points": np.full((3, 5, 3), 1e200)}, "'points' holds numbers as large as 1e+200"),
        ({**good, "image_names": np.array(["a"])}, "'image_names' has 1 entries"),
        ({**good, "image_names": np.array([1, 2, 3])}, "'image_names' is not a list of names"),
        ({**good, "tracks": np.full((3, 5, 2), np.inf), "visible": np.ones((3, 5), bool)}, "frame 0, point 0"),
    ]
    for arrays, expected in cases:
        np.savez(path, **arrays)
        text = message(path)
        assert expected in text
        assert str(path) in text


def test_nan_where_not_visible_is_fine(tmp_path: Path) -> None:
    pixels = np.ones((3, 5, 2))
    pixels[1, 2] = np.nan
    np.savez(tmp_path / "a.npz", tracks=pixels, K=K)
    assert not load_tracks(tmp_path / "a.npz").visible[1, 2]


def mat_parts() -> tuple[Tracks, list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    tracks = some_tracks(3, 7)
    tracks = Tracks.checked(np.nan_to_num(tracks.pixels, nan=5.0), K, points=tracks.points)
    normalised = [frame.T for frame in tracks.normalised()]
    assert tracks.points is not None
    return tracks, [frame.T for frame in tracks.pixels], normalised, [frame.T for frame in tracks.points]


def cells(frames: list[np.ndarray]) -> np.ndarray:
    array = np.empty((1, len(frames)), dtype=object)
    array[0] = frames
    return array


def structs(name: str, frames: list[np.ndarray]) -> np.ndarray:
    array = np.empty((1, len(frames)), dtype=[(name, object)])
    array[name][0] = frames
    return array


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("layout", ["scene.m", "scene.p", "p", "m", "p cells", "qgth stack", "qgth cells"])
def test_mat_layouts(tmp_path: Path, layout: str, normalised: bool) -> None:
    tracks, pixels, rays, truth = mat_parts()
    image = rays if normalised else pixels
    homogeneous = [np.concatenate([frame, np.ones((1, 7))]) for frame in image]
    content = {
        "scene.m": {"scene": {"m": structs("m", image), "K": K, "Pgth": structs("P", truth)}},
        "scene.p": {"scene": {"m": structs("p", homogeneous), "K": K, "Pgth": structs("P", truth)}},
        "p": {"p": structs("p", homogeneous), "KK": K, "Pgth": structs("P", truth), "v": np.ones((7, 3))},
        "m": {"m": structs("m", image), "K": K, "Pgth": cells(truth), "v": cells([np.ones((1, 7))] * 3)},
        "p cells": {"p": cells(image), "K": K, "Pgth": cells(truth)},
        "qgth stack": {"qgth": np.concatenate(image), "K": K, "Pgth": np.concatenate(truth)},
        "qgth cells": {"qgth": cells(homogeneous), "K": K, "Pgth": cells(truth)},
    }[layout]
    savemat(tmp_path / "a.mat", content)
    read = load_tracks(tmp_path / "a.mat")
    np.testing.assert_allclose(read.pixels, tracks.pixels, atol=1e-9)
    np.testing.assert_array_equal(read.points, tracks.points)
    assert read.visible.all()


def test_mat_visibility_and_unknown_truth(tmp_path: Path) -> None:
    _, pixels, _, truth = mat_parts()
    visible = np.ones((7, 3), dtype=bool)
    visible[2, 1] = False
    truth[0][:, 4] = 0.0
    savemat(tmp_path / "a.mat", {"p": structs("p", pixels), "v": visible, "Pgth": structs("P", truth)})
    assert "'K' is missing" in message(tmp_path / "a.mat")
    tracks = load_tracks(tmp_path / "a.mat", K)
    np.testing.assert_array_equal(tracks.visible, visible.T)
    assert tracks.points is not None
    assert np.isnan(tracks.points[0, 4]).all()
    assert np.isfinite(tracks.points[1]).all()


def test_mat_that_cannot_be_used(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"banana": 1.0})
    assert "found 'banana'" in message(path)
    savemat(path, {"p": cells([np.ones((2, 5)), np.ones((2, 6))]), "K": K})
    assert "'p' holds between 5 and 6 points" in message(path)
    savemat(path, {"p": np.ones((3, 5)), "K": K})
    assert "'p' has shape (3, 5)" in message(path)
    savemat(path, {"p": np.ones((6, 5)), "K": np.eye(2)})
    assert "'K' has shape (2, 2)" in message(path)
    savemat(path, {"p": np.ones((6, 5)), "K": K, "v": np.ones((4, 4))})
    assert "'v' has shape (4, 4)" in message(path)
    path.write_bytes(path.read_bytes()[:300])
    assert str(path) in message(path)
    path.write_text("no matlab file at all" * 20)
    assert "not a readable .mat file" in message(path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    assert "-v7" in message(path)


def test_csv(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("point,frame,x,y,quality\n7,2,10.5,20,1\n7,4,11,21,1\n\n9,2,30,40,0\n")
    assert "--intrinsics" in message(path)
    tracks = load_tracks(path, "500,500,320,240")
    assert tracks.image_names == ("frame 2", "frame 4")
    np.testing.assert_array_equal(tracks.pixels[0], [[10.5, 20], [30, 40]])
    np.testing.assert_array_equal(tracks.visible, [[True, True], [True, False]])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("frame,point,x\n1,1,1\n", "column 'y' is missing"),
        ("frame,point,x,y\n", "no observation"),
        ("frame,point,x,y\n1,1,1,1\n1,2,abc,1\n", "line 3"),
        ("frame,point,x,y\n1,1,1\n", "line 2"),
        ("frame,point,x,y\n1.5,1,1,1\n", "line 2"),
        ("frame,point,x,y\n1,1,1,1\n1,1,2,2\n", "line 3 gives frame 1, point 1 a second time"),
        ("\x00\x01\x02", "'frame' is missing"),
    ],
)
def test_csv_that_cannot_be_used(tmp_path: Path, content: str, expected: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(content)
    text = message(path, "500,500,320,240")
    assert expected in text
    assert str(path) in text


def test_csv_of_huge_numbers_does_not_allocate_them(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("frame,point,x,y\n0,0,1,1\n999999999999,888888888888,2,2\n")
    assert load_tracks(path, "500,500,320,240").pixels.shape == (2, 2, 2)


@pytest.mark.parametrize("text", ["500, 510, 320, 240", "[500 0 320; 0 510 240; 0 0 1]"])
def test_intrinsics(tmp_path: Path, text: str) -> None:
    np.testing.assert_array_equal(parse_intrinsics(text), K)
    (tmp_path / "K.txt").write_text(text + "\n")
    np.testing.assert_array_equal(parse_intrinsics(tmp_path / "K.txt"), K)


def test_intrinsics_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text("focal 3")
    (tmp_path / "K.png").write_bytes(b"\xff\xfe\x00\x81")
    for text, expected in [
        ("1,2,3", "holds 3 numbers"),
        ("0,500,1,1", "focal lengths 0 and 500"),
        ("nan,500,1,1", "focal lengths nan"),
        ("none.txt", "neither numbers nor an existing file"),
        (tmp_path, "is a folder"),
        (tmp_path / "K.txt", "something other than numbers"),
        (tmp_path / "K.png", "not a text file"),
        ("1 0 0 0 1 0 0 0 2", "last row"),
    ]:
        with pytest.raises(InputError, match=expected):
            parse_intrinsics(text)
