"""Every loader on a small file of its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import Tracks, load_tracks
from experiments.loaders import datasets
from experiments.loaders.__main__ import main
from factors.surface import ORTHOGRAPHIC


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    return isometric_bending(n_frames=3, n_points=12).tracks


def by_image(array: np.ndarray) -> np.ndarray:
    """(rows F, P) from (F, P, rows)."""
    return array.transpose(0, 2, 1).reshape(-1, array.shape[1])


def write_normalised(folder: Path, tracks: Tracks) -> None:
    savemat(folder / "any.mat", {"qgth": by_image(tracks.normalised()), "Pgth": by_image(tracks.points)})


def write_scene(folder: Path, tracks: Tracks) -> None:
    image = np.array([(frame.T,) for frame in tracks.pixels], dtype=[("m", object)])
    truth = np.array([(frame.T,) for frame in tracks.points], dtype=[("P", object)])
    savemat(folder / "flag.mat", {"scene": {"m": image, "Pgth": truth, "K": tracks.K[0]}})
    np.savetxt(folder / "K.txt", tracks.K[0])


def write_stacked(folder: Path, tracks: Tracks) -> None:
    savemat(folder / "seq.mat", {"W": by_image(tracks.pixels), "GT": by_image(tracks.points), "K": tracks.K[0]})


def write_kinect(folder: Path, tracks: Tracks) -> None:
    image = np.array([(frame.T,) for frame in tracks.pixels], dtype=[("p", object)])
    truth = np.array([(frame.T,) for frame in tracks.points], dtype=[("P", object)])
    savemat(folder / "KinectPaper.mat", {"p": image, "Pgth": truth})
    savemat(folder / "camcalib.mat", {"KK": tracks.K[0]})


WRITERS = {
    "rug": write_normalised,
    "flag_450": write_scene,
    "kinect_paper_full": write_kinect,
    "nrsfm_challenge": write_stacked,
    "dense_paper": write_stacked,
    "dense_tshirt": write_stacked,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_small_file_of_the_layout_is_read(name: str, tmp_path: Path, tracks: Tracks) -> None:
    WRITERS[name](tmp_path, tracks)
    loaded = datasets()[name].load(tmp_path)
    np.testing.assert_allclose(loaded.normalised(), tracks.normalised(), atol=1e-12)
    np.testing.assert_allclose(loaded.points, tracks.points)


def test_sequences_of_the_challenge_without_a_camera_are_orthographic(tmp_path: Path) -> None:
    truth = isometric_bending(n_frames=3, n_points=12, camera=ORTHOGRAPHIC).tracks.points
    savemat(tmp_path / "seq.mat", {"W": by_image(truth[..., :2]), "GT": by_image(truth)})
    loaded = datasets()["nrsfm_challenge"].load(tmp_path)
    assert loaded.camera is ORTHOGRAPHIC
    np.testing.assert_allclose(loaded.normalised(), truth[..., :2])
    np.testing.assert_allclose(loaded.points, truth)


def test_every_data_set_says_where_it_is_to_be_had(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(datasets()) == {*WRITERS, "mandala", "hamlyn", "cloth_r1"}
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed and dataset.source in listed for name, dataset in datasets().items())


def test_a_data_set_is_converted_to_a_track_file(tmp_path: Path, tracks: Tracks) -> None:
    write_stacked(tmp_path, tracks)
    assert main(["nrsfm_challenge", str(tmp_path), str(tmp_path / "tracks.npz")]) == 0
    np.testing.assert_allclose(load_tracks(tmp_path / "tracks.npz").pixels, tracks.pixels)


@pytest.mark.parametrize("name", ["mandala", "hamlyn"])
def test_depth_maps_give_the_truth_of_tracked_points(name: str, tmp_path: Path) -> None:
    """A textured plane at depth 2 that shifts by one pixel per image."""
    cv2 = pytest.importorskip("cv2")
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (170, 210)), (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    for part in ("images", "depth"):
        (tmp_path / part).mkdir()
    for f in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{f}.png"), texture[10 + f : 130 + f, 10:170])
        np.save(tmp_path / "depth" / f"{f}.npy", np.full((120, 160), 2.0))
    (tmp_path / "K.txt").write_text("150,150,80,60")
    tracks = datasets()[name].load(tmp_path)
    seen = tracks.visible
    assert seen.sum() > 30
    np.testing.assert_allclose(tracks.points[seen][:, 2], 2.0)
    np.testing.assert_allclose(tracks.points[seen][:, :2], 2.0 * tracks.normalised()[seen])


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("rug", None, "holds 0 files '\\*.mat', expected one"),
        ("nrsfm_challenge", {"GT": np.zeros((6, 4))}, "field 'W' is missing"),
        ("nrsfm_challenge", {"W": np.zeros((3, 4)), "K": np.eye(3)}, r"'W' has shape \(3, 4\), expected 2 rows per"),
        ("dense_paper", {"W": np.zeros((4, 4))}, "field 'K' is missing"),
        ("kinect_paper_full", {"p": 1}, "KinectPaper.mat: no such file"),
    ],
)
def test_bad_folders_are_refused_by_name(name: str, fields: dict | None, message: str, tmp_path: Path) -> None:
    if fields is not None:
        savemat(tmp_path / "other.mat", fields)
    with pytest.raises(InputError, match=message):
        datasets()[name].load(tmp_path)
