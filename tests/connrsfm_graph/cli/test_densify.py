"""`connrsfm densify` and `connrsfm train-depth` from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from connrsfm_graph.dense import choose
from connrsfm_graph.reconstruction import RESULT_FILE
from factors.surface import ORTHOGRAPHIC
from tests.connrsfm_graph.cli.conftest import Ended
from tests.connrsfm_graph.dense.surface import sheet, write_images

Command = Callable[..., Ended]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    sheet().save(tmp_path / "result" / RESULT_FILE)
    return tmp_path / "result"


def test_densify_writes_the_folder_and_says_how(connrsfm: Command, result: Path, tmp_path: Path) -> None:
    images = write_images(tmp_path / "images")
    ended = connrsfm("densify", result, "--images", images, "--method", "spline")
    assert (ended.status, ended.err) == (0, "")
    assert ended.out == f"{result / 'dense' / 'index.json'}: 3 surfaces by spline (as asked for)\n"
    assert [frame["name"] for frame in json.loads((result / "dense" / "index.json").read_text())["frames"]] == [
        "000.png",
        "001.png",
        "002.png",
    ]


def test_densify_chooses_between_both_methods(connrsfm: Command, result: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    ended = connrsfm("densify", result, "--images", write_images(tmp_path / "images"))
    assert ended.status == 0
    assert "cross-validated error of depth" in ended.out


def test_a_wrong_checkpoint_is_one_sentence(connrsfm: Command, result: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    (tmp_path / "wrong.pt").write_text("no weights")
    images = write_images(tmp_path / "images")
    ended = connrsfm("densify", result, "--images", images, "--checkpoint", tmp_path / "wrong.pt")
    assert ended.status == 2
    assert ended.err == (
        f"connrsfm densify: {tmp_path / 'wrong.pt'}: cannot be read as a checkpoint (damaged or of another format)\n"
    )


def test_without_a_result_or_images_it_is_one_sentence(connrsfm: Command, result: Path, tmp_path: Path) -> None:
    ended = connrsfm("densify", tmp_path, "--images", tmp_path)
    assert ended.status == 2
    assert "holds no result.npz" in ended.err
    ended = connrsfm("densify", result, "--images", tmp_path / "nowhere")
    assert ended.status == 2
    assert ended.err.count("\n") == 1


def test_surfaces_seen_by_an_orthographic_camera_are_refused(connrsfm: Command, result: Path, tmp_path: Path) -> None:
    replace(sheet(), camera=ORTHOGRAPHIC).save(result / RESULT_FILE)
    ended = connrsfm("densify", result, "--images", write_images(tmp_path / "images"))
    assert ended.status == 2
    assert "was seen by an orthographic camera" in ended.err


def test_train_depth_writes_a_checkpoint(connrsfm: Command, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    out = tmp_path / "new" / "a.pt"
    ended = connrsfm("train-depth", "--out", out, "--steps", 1, "--batch", 2, "--held-out", 2)
    assert (ended.status, ended.out) == (0, f"{out}\n")
    assert "step 1: loss" in ended.err
    assert sorted(file.name for file in out.parent.iterdir()) == ["a.md", "a.pt"]
    assert "--variant compact --steps 1 --batch 2" in (out.parent / "a.md").read_text()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--variant", "unet"], "network 'unet' is unknown, expected one of compact, densenet169, resnet50"),
        (["--size", "50"], "image size 50, expected a multiple of 32 from 64"),
        (["--steps", "0"], "steps is 0, expected at least 1"),
        (["--device", "tpu"], "--device tpu: not available"),
    ],
)
def test_bad_settings_of_a_training_are_one_sentence(
    connrsfm: Command, tmp_path: Path, options: list[str], told: str
) -> None:
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    ended = connrsfm("train-depth", "--out", tmp_path / "a.pt", *options)
    assert ended.status == 2
    assert told in ended.err
    assert ended.err.count("\n") == 1


def test_train_depth_without_torch_names_the_extra(
    connrsfm: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choose, "find_spec", lambda name: None)
    ended = connrsfm("train-depth", "--out", tmp_path / "a.pt")
    assert ended.status == 2
    assert "pip install '.[dense]'" in ended.err
