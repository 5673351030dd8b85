"""Bad input through the command line: status 2, one sentence that names file, field and mend, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from .conftest import Ended, arrays

Run = Callable[..., Ended]


def refused(ended: Ended, *parts: str) -> None:
    assert ended.status == 2, ended
    assert ended.out == ""
    assert ended.err.count("\n") == 1
    assert "Traceback" not in ended.err
    for part in parts:
        assert part in ended.err


def changed(**changes: np.ndarray) -> dict[str, np.ndarray]:
    return {**arrays(), **changes}


def nan_tracks() -> dict[str, np.ndarray]:
    fields = arrays()
    fields["tracks"][1, 3] = np.nan
    return fields


def invisible_frame() -> dict[str, np.ndarray]:
    fields = arrays()
    fields["visible"][2] = False
    return fields


def all_duplicates() -> dict[str, np.ndarray]:
    fields = arrays()
    fields["tracks"][:] = fields["tracks"][:, :1]
    return fields


def mirrored() -> dict[str, np.ndarray]:
    fields = arrays()
    fields["tracks"][1, :, 0] *= -1
    return fields


def disconnected() -> dict[str, np.ndarray]:
    fields = arrays(F=6, P=40)
    fields["visible"][:3, 20:] = False
    fields["visible"][3:, :20] = False
    return fields


def bad_focal() -> dict[str, np.ndarray]:
    return changed(K=np.diag([-500.0, 500.0, 1.0]))


BAD_TRACKS: list[tuple[Callable[[], dict[str, np.ndarray]], tuple[str, ...]]] = [
    (nan_tracks, ("'tracks' is NaN", "frame 1, point 3", "mark it not visible")),
    (invisible_frame, ("image 2 shows no point at all", "leave it out")),
    (all_duplicates, ("shows 1 points, expected at least",)),
    (lambda: arrays(F=2), ("shows 2 images, expected at least 3",)),
    (lambda: arrays(P=3), ("holds 3 points, expected at least",)),
    (mirrored, ("image 1 shows the points mirrored",)),
    (disconnected, ("frames 0-2; 3-5", "add tracks that link the groups")),
    (bad_focal, ("'K' has a non-positive focal length",)),
    (lambda: changed(tracks=np.zeros((4, 12, 3))), ("'tracks' has shape (4, 12, 3), expected (frames, points, 2)",)),
    (lambda: changed(tracks=np.array([[{}] * 12] * 4)), ("'tracks' holds Python objects",)),
    (lambda: {"K": np.eye(3)}, ("field 'tracks' is missing",)),
]


@pytest.mark.parametrize(("make", "parts"), BAD_TRACKS)
def test_bad_tracks(
    connrsfm: Run, tmp_path: Path, make: Callable[[], dict[str, np.ndarray]], parts: tuple[str, ...]
) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **make())  # type: ignore[arg-type]
    refused(connrsfm("reconstruct", path, "--out", tmp_path / "out"), "bad.npz", *parts)
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.npz"]


def test_truncated_file(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    tracks_file.write_bytes(tracks_file.read_bytes()[:400])
    refused(connrsfm("reconstruct", tracks_file, "--out", tmp_path / "out"), "tracks.npz", "truncated")


def test_folder_instead_of_file(connrsfm: Run, tmp_path: Path) -> None:
    refused(connrsfm("reconstruct", tmp_path, "--out", tmp_path / "out"), "is a folder, expected a file")


def test_absent_file(connrsfm: Run, tmp_path: Path) -> None:
    refused(connrsfm("reconstruct", tmp_path / "no.npz", "--out", tmp_path / "out"), "no.npz: no such file")


def test_mat_without_known_fields(connrsfm: Run, tmp_path: Path) -> None:
    savemat(tmp_path / "bad.mat", {"other": np.zeros(3)})
    refused(connrsfm("reconstruct", tmp_path / "bad.mat", "--out", tmp_path / "out"), "bad.mat", "expected")


def test_output_that_is_a_file(connrsfm: Run, tracks_file: Path) -> None:
    before = tracks_file.read_bytes()
    refused(connrsfm("reconstruct", tracks_file, "--out", tracks_file), "is a file; expected a folder")
    assert tracks_file.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (("--method", "magic"), ("--method magic: no such method, expected one of connrsfm",)),
        (("--set", "solve.iteratons=3"), ("did you mean solve.iterations?",)),
        (("--set", "solve.iterations=few"), ("few is not a whole number",)),
        (("--config", "absent.toml"), ("absent.toml: no such file",)),
        (("--intrinsics", "500,500"), ("expected fx,fy,cx,cy",)),
        (("--mode", "best"), ("invalid choice: 'best'",)),
        (("--camera", "fisheye"), ("invalid choice: 'fisheye'",)),
        (("--seed", "x"), ("invalid int value",)),
    ],
)
def test_bad_options(
    connrsfm: Run, tracks_file: Path, tmp_path: Path, options: tuple[str, ...], parts: tuple[str, ...]
) -> None:
    refused(connrsfm("reconstruct", tracks_file, "--out", tmp_path / "out", *options), *parts)
    assert [entry.name for entry in tmp_path.iterdir()] == ["tracks.npz"]


def test_no_command_and_unknown_command(connrsfm: Run) -> None:
    refused(connrsfm(), "COMMAND")
    refused(connrsfm("recon"), "invalid choice: 'recon'")


def test_evaluate_without_or_with_other_truth(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    connrsfm("reconstruct", tracks_file, "--out", out, "--no-report")
    fields = arrays()
    del fields["points"]
    np.savez(tmp_path / "blind.npz", **fields)  # type: ignore[arg-type]
    np.savez(tmp_path / "other.npz", **arrays(P=9))  # type: ignore[arg-type]
    refused(connrsfm("evaluate", out, "--truth", tmp_path / "blind.npz"), "blind.npz: holds no true points")
    refused(connrsfm("evaluate", out, "--truth", tmp_path / "other.npz"), "other.npz", "4 x 9", "4 x 12")
    refused(connrsfm("evaluate", tracks_file, "--truth", tracks_file), "tracks.npz: field 'pixels' is missing")
    refused(connrsfm("evaluate", tmp_path, "--truth", tracks_file), "holds no result.npz")
    refused(connrsfm("report", tmp_path), "holds no result.npz")
    refused(connrsfm("report", tracks_file), "is a file, expected the folder")
    (out / "run.json").write_text('{"source": 1, "method": "mine", "seed": 0}')
    refused(connrsfm("report", out), "run.json: 'source' is not a text")


def test_track_refuses(connrsfm: Run, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    out = tmp_path / "tracks.npz"
    refused(connrsfm("track", empty, "--intrinsics", "1,1,0,0", "--out", out), "holds no images")
    refused(connrsfm("track", empty, "--intrinsics", "0,1,0,0", "--out", out), "focal lengths")
    refused(connrsfm("track", empty, "--intrinsics", "1,1,0,0", "--out", tmp_path / "x.csv"), "ends in .npz")
    refused(
        connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out, "--distortion", "1,2"), "expected k1,k2,p1,p2"
    )
    refused(
        connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out, "--picture", "a.jpg"),
        "name that ends in .png",
    )
    refused(
        connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out, "--save-images", empty), "expected another"
    )
    refused(connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out, "--keyframes", 2), "expected at least 3")
    image = np.random.default_rng(0).integers(0, 255, (60, 80), dtype=np.uint8)
    cv2.imwrite(str(empty / "0.png"), image)
    refused(connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out), "shows 1 image, expected at least 3")
    for number in (1, 2):
        cv2.imwrite(str(empty / f"{number}.png"), image)
    cv2.imwrite(str(empty / "1.png"), np.zeros_like(image))
    refused(connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out), "1.png: is blank", "leave it out")
    cv2.imwrite(str(empty / "1.png"), image[:50])
    refused(connrsfm("track", empty, "--intrinsics", "9,9,0,0", "--out", out), "1.png: has 80 x 50 pixels but 0.png")
    assert not out.exists()
