"""Each command does its job, says where the result is, and ends with the right status."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.synthetic.rendered import RenderConfig, render_sequence
from connrsfm_graph.tracks import load_tracks
from factors.surface import ORTHOGRAPHIC, PERSPECTIVE

from .conftest import Ended, arrays

Run = Callable[..., Ended]


def test_reconstruct_writes_everything_and_says_where(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    ended = connrsfm(
        "reconstruct", tracks_file, "--out", out, "--seed", 7, "--set", "solve.iterations=3", "--mode", "paper"
    )
    assert ended.status == 0, ended.err
    assert str(out) in ended.out
    assert re.search(r"3D error \d+\.\d+ %", ended.out)
    assert ended.err == ""
    assert sorted(path.name for path in out.iterdir()) == [
        "config.toml",
        "pictures",
        "report.html",
        "result.npz",
        "run.json",
    ]
    assert Reconstruction.load(out).n_points == 12
    record = RunRecord.load(out)
    assert (record.source, record.method, record.seed) == (str(tracks_file), "connrsfm", 7)
    assert (
        record.configuration
        == tomllib.loads((out / "config.toml").read_text())
        == {
            "seed": 7,
            "solve": {"iterations": 3},
        }
    )


def test_the_camera_is_the_one_asked_for(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    for camera in (PERSPECTIVE, ORTHOGRAPHIC):
        out = tmp_path / camera.name
        assert connrsfm("reconstruct", tracks_file, "--out", out, "--camera", camera.name, "--no-report").status == 0
        assert Reconstruction.load(out).camera is camera
        assert "frame" in connrsfm("evaluate", out, "--truth", tracks_file).out


def test_same_run_gives_the_same_result_file(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert connrsfm("reconstruct", tracks_file, "--out", tmp_path / name, "--no-report").status == 0
    assert (tmp_path / "a" / "result.npz").read_bytes() == (tmp_path / "b" / "result.npz").read_bytes()
    assert not (tmp_path / "a" / "report.html").exists()


def test_written_configuration_repeats_the_run(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    connrsfm("reconstruct", tracks_file, "--out", tmp_path / "a", "--set", "solve.iterations=4", "--no-report")
    config = tmp_path / "a" / "config.toml"
    ended = connrsfm("reconstruct", tracks_file, "--out", tmp_path / "b", "--config", config, "--no-report")
    assert ended.status == 0
    assert (tmp_path / "b" / "config.toml").read_text() == config.read_text()
    assert connrsfm("settings", "--config", config).out == config.read_text()
    assert "# How often." in config.read_text()


def test_evaluate_prints_only_json(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    connrsfm("reconstruct", tracks_file, "--out", tmp_path / "out", "--no-report")
    ended = connrsfm("evaluate", tmp_path / "out", "--truth", tracks_file, "--json")
    assert ended.status == 0
    figures = json.loads(ended.out)
    assert {"e3d_percent", "shape_error_deg", "rmse_3d", "coverage", "per_frame"} <= set(figures)
    assert figures["coverage"] == 1.0
    assert len(figures["per_frame"]) == 4
    table = connrsfm("evaluate", tmp_path / "out" / "result.npz", "--truth", tracks_file).out.splitlines()
    assert [line.split()[0] for line in table] == ["frame", "0", "1", "2", "3", "all"]
    assert float(table[-1].split()[2]) == pytest.approx(figures["e3d_percent"], abs=1e-3)


def test_report_builds_the_page_again(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    connrsfm("reconstruct", tracks_file, "--out", out, "--no-report")
    ended = connrsfm("report", out)
    assert ended.status == 0
    assert ended.out.strip() == str(out / "report.html")
    assert "3D error" not in (out / "report.html").read_text()
    assert connrsfm("report", out, "--truth", tracks_file, "--renders", 80, "--view=-20,10").status == 0
    assert "3D error" in (out / "report.html").read_text()
    assert (out / "renders" / "0000_error.png").exists()
    for option, value, expected in (
        ("--view", "1", "two numbers"),
        ("--renders", 3, "16 to 8192"),
        ("--rerun", "a.txt", ".rrd"),
    ):
        ended = connrsfm("report", out, option, value)
        assert (ended.status, ended.err.count("\n")) == (2, 1)
        assert expected in ended.err


def test_track_follows_images(connrsfm: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (160, 220)), (0, 0), 2.0)
    texture = np.clip(128 + 6 * (texture - texture.mean()), 20, 255).astype(np.uint8)
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(4):
        cv2.imwrite(str(folder / f"{number}.png"), texture[:120, 3 * number : 3 * number + 180])
    out = tmp_path / "sub" / "tracks.npz"
    ended = connrsfm("track", folder, "--intrinsics", "300,300,90,60", "--out", out, "--set", "points=60")
    assert ended.status == 0, ended.err
    tracks = load_tracks(out)
    assert tracks.n_frames == 4
    assert f"{tracks.n_points} points in 4 images" in ended.out
    motion = np.nanmedian(np.diff(tracks.pixels, axis=0), axis=(0, 1))
    np.testing.assert_allclose(motion, [-3, 0], atol=0.1)

    picture, kept = tmp_path / "tracks.png", tmp_path / "kept"
    arguments = ("track", folder, "--intrinsics", "300,300,90,60", "--out", out, "--set", "points=60")
    extra = ("--keyframes", 3, "--distortion=-0.01,0,0,0", "--picture", picture, "--save-images", kept)
    ended = connrsfm(*arguments, *extra)
    assert ended.status == 0, ended.err
    assert "in 3 images" in ended.out
    assert "wrong tracks dropped" in ended.out
    tracks = load_tracks(out)
    assert tracks.image_names is not None
    assert sorted(path.name for path in kept.iterdir()) == list(tracks.image_names)
    assert cv2.imread(str(kept / tracks.image_names[0])).shape == (120, 180, 3)
    assert cv2.imread(str(picture)).std() > 20


def test_demo_makes_everything_itself(connrsfm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = RenderConfig(frames=4, width=320, height=240, focal=310)
    monkeypatch.setattr(
        "connrsfm_graph.synthetic.rendered.render_sequence", lambda progress: render_sequence(small, progress)
    )
    ended = connrsfm("demo", "--out", tmp_path / "demo")
    assert ended.status == 0, ended.err
    assert "3D error" in ended.out
    tracks = load_tracks(tmp_path / "demo" / "tracks.npz")
    assert tracks.points is not None
    assert tracks.image_names == ("000.png", "001.png", "002.png", "003.png")
    assert len(list((tmp_path / "demo" / "images").iterdir())) == 4
    assert "0000_tracks.png" in {path.name for path in (tmp_path / "demo" / "pictures").iterdir()}
    assert len(list((tmp_path / "demo" / "dense" / "glb").iterdir())) == 4
    assert "Dense surfaces" in (tmp_path / "demo" / "report.html").read_text()


def test_interrupted_run_leaves_nothing(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    ended = connrsfm("reconstruct", tracks_file, "--out", tmp_path / "out", "--method", "interrupt")
    assert ended.status == 130
    assert "interrupted" in ended.err
    assert [path.name for path in tmp_path.iterdir()] == ["tracks.npz"]


def test_interrupted_page_keeps_the_result(
    connrsfm: Run, tracks_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("connrsfm_graph.report.page._charts", interrupt)
    assert connrsfm("reconstruct", tracks_file, "--out", tmp_path / "out").status == 130
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.toml", "result.npz", "run.json"]


def test_failure_is_one_sentence_and_debug_shows_where(connrsfm: Run, tracks_file: Path, tmp_path: Path) -> None:
    arguments = ("reconstruct", tracks_file, "--out", tmp_path / "out", "--method", "fail")
    ended = connrsfm(*arguments)
    assert ended.status == 1
    assert ended.err == "connrsfm reconstruct: unexpected ZeroDivisionError: by nothing (--debug shows where)\n"
    assert "Traceback" in connrsfm(*arguments, "--debug").err
    assert not (tmp_path / "out").exists()


def test_duplicate_tracks_are_told(connrsfm: Run, tmp_path: Path) -> None:
    fields = arrays()
    fields["tracks"][:, 5] = fields["tracks"][:, 2]
    np.savez(tmp_path / "tracks.npz", **fields)  # type: ignore[arg-type]
    ended = connrsfm("reconstruct", tmp_path / "tracks.npz", "--out", tmp_path / "out", "--no-report")
    assert ended.status == 0
    assert "warning: 1 points lie at the same pixel as another one (point 5 as point 2" in ended.err
    assert len(RunRecord.load(tmp_path / "out").warnings) == 1


@pytest.mark.parametrize("command", [(), *((name,) for name in ("demo", "track", "reconstruct", "evaluate", "report"))])
def test_help(connrsfm: Run, command: tuple[str, ...]) -> None:
    ended = connrsfm(*command, "--help")
    assert ended.status == 0
    assert "usage: connrsfm" in ended.out


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys; import connrsfm_graph.cli.main as m; m.main(['--help']);"
        "heavy = {'numba', 'gtsam', 'cv2', 'scipy', 'networkx', 'torch', 'matplotlib'} & set(sys.modules);"
        "sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
