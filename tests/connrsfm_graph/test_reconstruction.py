"""Results and records survive a round trip; damaged files are named in one sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord, package_versions, peak_memory_mib


def small_reconstruction(names: bool = True) -> Reconstruction:
    rng = np.random.default_rng(0)
    F, P, E = 3, 5, 2
    points = rng.normal(size=(F, P, 3), loc=5.0)
    points[1, 2] = np.nan
    return Reconstruction(
        pixels=rng.uniform(0, 640, (F, P, 2)),
        K=np.tile(np.diag([500.0, 500.0, 1.0]), (F, 1, 1)),
        visible=np.isfinite(points[..., 0]),
        points=points,
        normals=np.tile([0.0, 0.0, -1.0], (F, P, 1)),
        depth=points[..., 2],
        first_order=rng.normal(size=(F, P, 2)),
        second_order=rng.normal(size=(F, P, 3)),
        edges=np.array([[0, 1], [1, 2]]),
        edge_weight=np.ones(E),
        conformal_scale=np.full((E, P), 1.1),
        depth_std=np.full((F, P), np.nan),
        log_factor=np.zeros((F, P)),
        interpolated=np.zeros((F, P), bool),
        outlier=np.zeros((F, P), bool),
        image_names=np.array(["a.jpg", "b.jpg", "c.jpg"]) if names else None,
        ambiguous=np.array([0, 1, 1]) if names else None,
        alternative=points[:, ::-1] if names else None,
    )


@pytest.mark.parametrize("names", [True, False])
def test_round_trip_and_same_bytes(tmp_path: Path, names: bool) -> None:
    made = small_reconstruction(names)
    made.save(tmp_path / "result.npz")
    made.save(tmp_path / "again.npz")
    assert (tmp_path / "result.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    read = Reconstruction.load(tmp_path)
    for item in fields(Reconstruction):
        np.testing.assert_array_equal(getattr(read, item.name), getattr(made, item.name), err_msg=item.name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.npz", "result.npz"]


def test_unknown_fields_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "result.npz"
    small_reconstruction().save(path)
    with np.load(path) as archive:
        np.savez(path, **archive, future=np.zeros(3))
    assert Reconstruction.load(path).n_points == 5


def damaged(path: Path, **changes: object) -> None:
    small_reconstruction().save(path)
    with np.load(path) as archive:
        arrays = {**archive, **changes}
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normals": None}, "'normals' is missing"),
        ({"depth": np.zeros((3, 4))}, r"'depth' has shape \(3, 4\), expected \(3, 5\)"),
        ({"visible": np.zeros((3, 5))}, "'visible' holds float64 values, expected true and false"),
        ({"depth": np.full((3, 5), "x")}, "'depth' holds <U1 values, expected numbers"),
        ({"ambiguous": np.zeros(4, int)}, r"'ambiguous' has shape \(4,\), expected \(3\)"),
        ({"edges": np.array([[0, 7], [1, 2]])}, "'edges' names an image outside 0 to 2"),
        ({"image_names": np.array(["a"])}, "'image_names' is not a list of 3 names"),
        ({"depth": np.array([{}] * 15).reshape(3, 5)}, "'depth' holds Python objects"),
    ],
)
def test_bad_result_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = tmp_path / "result.npz"
    damaged(path, **changes)
    with pytest.raises(InputError, match=message) as caught:
        Reconstruction.load(path)
    assert "result.npz" in str(caught.value)


def test_truncated_missing_and_folder(tmp_path: Path) -> None:
    path = tmp_path / "result.npz"
    with pytest.raises(InputError, match=r"no such file"):
        Reconstruction.load(path)
    with pytest.raises(InputError, match=r"holds no result\.npz"):
        Reconstruction.load(tmp_path)
    small_reconstruction().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="truncated"):
        Reconstruction.load(path)
    middle = len(whole) // 3
    path.write_bytes(whole[:middle] + bytes(64) + whole[middle + 64 :])
    with pytest.raises(InputError, match="truncated or damaged"):
        Reconstruction.load(path)


def test_record_round_trip(tmp_path: Path) -> None:
    record = RunRecord(
        source="tracks.npz",
        method="connrsfm",
        seed=3,
        configuration={"graph": {"edges": 4}},
        decisions={"pixel_sigma": np.float64(0.5), "depths": np.array([1.0, np.nan])},
        warnings=("one",),
        cost_history={"joint": [2.0, 1.0]},
        seconds={"warps": 1.5},
        peak_memory_mib=peak_memory_mib(),
        versions=package_versions(),
    )
    record.save(tmp_path / "run.json")
    read = RunRecord.load(tmp_path)
    assert read.decisions == {"pixel_sigma": 0.5, "depths": [1.0, None]}
    assert read.warnings == ("one",)
    assert read.cost_history == record.cost_history
    assert read.peak_memory_mib > 10
    content = json.loads((tmp_path / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps({**content, "future": 1}))
    assert RunRecord.load(tmp_path / "run.json") == read


def test_figures_that_are_no_numbers_read_back_as_such(tmp_path: Path) -> None:
    nan = float("nan")
    record = RunRecord("a", "b", 0, cost_history={"x": [nan, 1.0]}, seconds={"y": nan}, peak_memory_mib=nan)
    record.save(tmp_path / "run.json")
    read = RunRecord.load(tmp_path)
    np.testing.assert_array_equal(read.cost_history["x"], [nan, 1.0])
    np.testing.assert_array_equal([read.seconds["y"], read.peak_memory_mib], [nan, nan])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a JSON file"),
        ("[]", "holds no JSON object"),
        ("{}", "key 'source' is missing"),
        ('{"source": "a", "method": "b", "seed": "c"}', "'seed' is not a whole number"),
        ('{"source": "a", "method": "b", "seed": 0, "warnings": 7}', "'warnings' is not a list of sentences"),
        ('{"source": "a", "method": "b", "seed": 0, "decisions": []}', "'decisions' is not a table of decisions"),
        (
            '{"source": "a", "method": "b", "seed": 0, "cost_history": {"x": 3}}',
            "'cost_history' is not a table of lists",
        ),
        ('{"source": "a", "method": "b", "seed": 0, "seconds": {"x": "long"}}', "'seconds' is not a table of numbers"),
    ],
)
def test_bad_record_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=message):
        RunRecord.load(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count the parent, too")
def test_the_peak_memory_is_that_of_this_program_not_of_its_parent():
    ballast = np.ones(40_000_000)  # 305 MiB
    code = "from connrsfm_graph.run_record import peak_memory_mib as peak; print(peak())"
    shown = float(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout)
    assert 10 < shown < peak_memory_mib() - ballast.nbytes / 2**20
