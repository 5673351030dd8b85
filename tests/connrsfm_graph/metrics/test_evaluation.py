from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import evaluate


@pytest.fixture
def truth() -> np.ndarray:
    """Two frames of a gently curved sheet, 60 points, 2 units wide."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 1.0, (2, 60))
    return np.stack([np.stack([x, y, 5.0 + bend * x**2 + 0.2 * y], axis=-1) for bend in (0.3, -0.5)])


def test_a_similar_reconstruction_has_no_error(truth: np.ndarray) -> None:
    turn = Rotation.from_rotvec([0.2, -0.1, 0.4]).as_matrix()
    result = evaluate(np.stack([0.1 * truth[0], 3.0 * truth[1] @ turn.T]), truth)
    for figure in (result.e3d_percent, result.rmse_3d, result.rmse_3d_percent, result.median_3d_percent):
        assert figure == pytest.approx(0.0, abs=1e-10)
    assert result.coverage == 1.0
    assert result.per_frame[1]["scale"] == pytest.approx(1 / 3.0)


def test_the_truth_scores_its_floor(truth: np.ndarray) -> None:
    result = evaluate(2.0 * truth, truth)
    assert result.shape_error_deg == pytest.approx(result.shape_floor_deg)
    assert 0.0 < result.shape_floor_deg < 2.0


def test_figures_follow_their_definitions(truth: np.ndarray) -> None:
    """A displacement that no similarity undoes: opposite normal shifts in a balanced pattern."""
    corners = np.array([[x, y, 5.0] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 1.0)])
    saddle = 0.1 * np.array([1, -1, 0, 0, -1, 1])[:, None] * [0.0, 0.0, 1.0]
    result = evaluate((corners + saddle)[None], corners[None])
    scale = result.per_frame[0]["scale"]
    aligned = scale * (corners - [0.0, 0.0, 5.0] + saddle) + [0.0, 0.0, 5.0]
    distance = np.linalg.norm(aligned - corners, axis=1)
    assert result.e3d_percent == pytest.approx(100 * distance.mean() / np.sqrt(3) / 2.0)
    assert result.rmse_3d == pytest.approx(np.sqrt((distance**2).mean()))
    assert result.rmse_3d_percent == pytest.approx(50 * result.rmse_3d)
    assert result.median_3d_percent == pytest.approx(50 * np.median(distance))
    centred = corners - corners.mean(axis=0)
    assert result.frobenius_percent == pytest.approx(100 * np.linalg.norm(distance) / np.linalg.norm(centred))


def test_a_relief_reversal_is_an_error(truth: np.ndarray) -> None:
    mirrored = truth * [1.0, 1.0, -1.0] + [0.0, 0.0, 10.0]
    result = evaluate(mirrored, truth)
    assert result.e3d_percent > 1.0
    assert result.shape_error_deg > 10.0


def test_missing_points_lower_coverage_and_add_no_error(truth: np.ndarray) -> None:
    points, visible = truth.copy(), np.ones((2, 60), dtype=bool)
    points[0, :15] = np.nan
    visible[1, :20] = False
    points[1, :20] += 100.0  # not observed, so it must not matter
    truth[1, 20:25] = np.nan
    result = evaluate(points, truth, visible)
    assert result.e3d_percent == pytest.approx(0.0, abs=1e-10)
    assert result.coverage == pytest.approx((45 + 35) / (60 + 35))
    assert [frame["points"] for frame in result.per_frame] == [45, 35]


def test_a_frame_that_is_not_recovered_is_reported_as_such(truth: np.ndarray) -> None:
    points = truth.copy()
    points[0] = np.nan
    result = evaluate(points, truth)
    assert result.per_frame[0]["e3d_percent"] is None
    assert result.per_frame[0]["coverage"] == 0.0
    assert result.coverage == 0.5


def test_own_normals_are_judged_in_the_aligned_frame(truth: np.ndarray) -> None:
    normals = np.random.default_rng(1).standard_normal(truth.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    result = evaluate(truth @ turn.T, truth, normals=normals @ turn.T, true_normals=normals)
    assert result.normal_error_deg == pytest.approx(0.0, abs=1e-9)
    assert evaluate(truth, truth).normal_error_deg is None


def test_true_normals_without_length_are_unknown(truth: np.ndarray) -> None:
    """An angle with nothing is no perfect angle."""
    bent = truth + 0.3 * truth[..., :1] ** 3 * [0.0, 0.0, 1.0]
    assert np.isnan(evaluate(bent, truth, true_normals=np.zeros_like(truth)).shape_error_deg)
    some = np.zeros_like(truth)
    some[:, ::2] = [0.0, 0.0, -1.0]
    known = evaluate(bent[:, ::2], truth[:, ::2], true_normals=some[:, ::2]).shape_error_deg
    assert known == pytest.approx(evaluate(bent, truth, true_normals=some).shape_error_deg, rel=0.2)


def test_to_dict_is_json_without_nan(truth: np.ndarray) -> None:
    unknown = np.full_like(truth, np.nan)
    text = json.dumps(evaluate(truth, truth, true_normals=unknown).to_dict(), allow_nan=False)
    assert json.loads(text)["shape_error_deg"] is None


def test_bad_input_is_named(truth: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"reconstructed points have shape \(2, 59, 3\)"):
        evaluate(truth[:, 1:], truth)
    with pytest.raises(InputError, match="no frame has 4"):
        evaluate(np.full_like(truth, np.nan), truth)
    behind = truth.copy()
    behind[1, 7] *= -1
    with pytest.raises(InputError, match="behind the camera in frame 1"):
        evaluate(behind, truth)
    assert evaluate(behind, truth, image=truth[..., :2]).e3d_percent > 0


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["tshirt.npz", "kinect_paper.npz", "flag.npz"])
def test_truth_against_itself_leaves_only_the_refit(name: str, realdata) -> None:
    """The reconstruction is refitted more smoothly than the truth: the shape error has a floor of up to 2 degrees."""
    data = np.load(realdata(name))
    result = evaluate(data["points"], data["points"], data["visible"])
    assert result.e3d_percent < 1e-10
    assert result.shape_error_deg == pytest.approx(result.shape_floor_deg)
    assert result.shape_error_deg < 2.0
