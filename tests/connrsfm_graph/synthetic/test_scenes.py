from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic import Scene, isometric_bending, mixed, moebius, scenes, spheres
from connrsfm_graph.synthetic.jet import Jet
from factors.conformal_pair import residuals
from factors.surface import metric

SCENES: dict[str, Callable[[], Scene]] = {
    "spheres": spheres,
    "spheres, 55 degrees": lambda: spheres(half_angle_deg=55.0, seed=3),
    "isometric bending": isometric_bending,
    "isometric bending, smooth": lambda: isometric_bending(20, 50, smooth=True, seed=1),
    "moebius": moebius,
    "moebius, strong": lambda: moebius(scale_ratio=(3.0, 4.5), seed=2),
    "mixed": lambda: mixed(n_points=100),
}


@pytest.fixture(params=SCENES, scope="module")
def scene(request: pytest.FixtureRequest) -> Scene:
    return SCENES[request.param]()


def chain(scene: Scene) -> np.ndarray:
    """Edges (0, 1), (1, 2), ... and one backwards."""
    frames = np.arange(scene.tracks.n_frames)
    return np.concatenate([np.stack([frames[:-1], frames[1:]], axis=1), [[frames[-1], 0]]])


def pair_rows(scene: Scene, edges: np.ndarray) -> np.ndarray:
    """The 21 rows of the pair factor at the truth, (E, P, 21)."""
    a, b = edges.T
    y = np.concatenate([scene.first_order, scene.second_order], axis=-1)
    log_rho = np.log(scene.conformal_scale(edges)) + scene.log_depth[b] - scene.log_depth[a]
    return residuals(scene.jets(edges).pair_data(scene.image[a], scene.image[b]), y[a], y[b], log_rho)


def test_tracks_are_projections_within_the_image(scene: Scene) -> None:
    points = scene.tracks.points
    np.testing.assert_allclose(scene.tracks.normalised(), points[..., :2] / points[..., 2:], atol=1e-14)
    np.testing.assert_allclose(np.exp(scene.log_depth), points[..., 2])
    assert (scene.tracks.pixels >= -0.5).all()
    assert (scene.tracks.pixels <= [639.5, 479.5]).all()
    assert scene.tracks.visible.all()


def test_normals_are_unit_and_face_the_camera(scene: Scene) -> None:
    points, normals = scene.tracks.points, scene.tracks.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-14)
    assert ((points * normals).sum(axis=-1) < 0).all()
    for f, surface in enumerate(scene.surfaces):
        tangents = np.einsum("kdp,pd->kp", surface.gradient, normals[f])
        np.testing.assert_allclose(tangents, 0.0, atol=1e-12 * np.abs(surface.gradient).max())


def test_metrics_are_related_by_the_conformal_scale(scene: Scene) -> None:
    """g_a = lambda^2 J^T g_b J (eq. 9), in metrics with their depth."""
    edges = chain(scene)
    a, b = edges.T
    g = metric(scene.image, scene.first_order, np.exp(scene.log_depth))
    J = scene.jets(edges).jacobian
    carried = scene.conformal_scale(edges)[..., None, None] ** 2 * np.swapaxes(J, -1, -2) @ g[b] @ J
    size = np.trace(g[a], axis1=-2, axis2=-1)[..., None, None]
    np.testing.assert_allclose(carried / size, g[a] / size, atol=1e-12)


def test_warps_map_points_to_points_and_invert(scene: Scene) -> None:
    forth, back = scene.jets(np.array([[0, 1]])), scene.jets(np.array([[1, 0]]))
    np.testing.assert_allclose(forth.value[0], scene.image[1], atol=1e-14)
    np.testing.assert_allclose(
        forth.jacobian @ back.jacobian, np.broadcast_to(np.eye(2), back.jacobian.shape), atol=1e-11
    )
    assert (np.linalg.det(forth.jacobian) > 0).all()


def test_truth_is_determined_by_the_seed() -> None:
    np.testing.assert_array_equal(moebius(seed=5).tracks.pixels, moebius(seed=5).tracks.pixels)
    assert np.abs(moebius(seed=5).tracks.pixels - moebius(seed=6).tracks.pixels).max() > 1.0


@pytest.mark.parametrize("half_angle_deg", [35.0, 55.0])
def test_spheres_satisfy_theorem_1(half_angle_deg: float) -> None:
    scene = spheres(half_angle_deg=half_angle_deg)
    assert np.abs(pair_rows(scene, chain(scene))).max() < 1e-10


def test_spheres_are_related_by_similarities() -> None:
    scene = spheres()
    scale = scene.conformal_scale(chain(scene))
    np.testing.assert_allclose(scale, scale[:, :1] * np.ones_like(scale), rtol=1e-12)
    chords = np.linalg.norm(scene.tracks.points[:, 1:] - scene.tracks.points[:, :1], axis=-1)
    np.testing.assert_allclose(chords[0] / chords[1], scale[0, 1:], rtol=1e-10)


def test_bent_sheets_are_isometric_and_not_congruent() -> None:
    scene = isometric_bending(12, 60, seed=4)
    np.testing.assert_allclose(scene.conformal_scale(chain(scene)), 1.0, rtol=1e-12)
    chords = np.linalg.norm(scene.tracks.points[:, 1:] - scene.tracks.points[:, :1], axis=-1)
    assert np.ptp(chords, axis=0).max() > 0.05


def test_bent_sheets_satisfy_the_intrinsic_rows_only() -> None:
    """Isometry keeps the intrinsic 2 x 2 block of the connections and the metric, not the second fundamental form."""
    scene = isometric_bending()
    rows = pair_rows(scene, chain(scene))
    connection = rows[..., :18].reshape(*rows.shape[:-1], 2, 3, 3)
    assert np.abs(connection[..., :2, :2]).max() < 1e-11
    assert np.abs(connection[..., 2, 2]).max() < 1e-11
    assert np.abs(rows[..., 18:]).max() < 1e-11
    assert np.abs(connection[..., 2, :2]).max() > 0.1


def test_a_smooth_motion_moves_little_from_frame_to_frame() -> None:
    smooth, independent = (isometric_bending(60, 30, smooth=s).image for s in (True, False))
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.2 * np.abs(np.diff(independent, axis=0)).max()


@pytest.mark.parametrize("ratio", [1.5, 4.0])
def test_inversions_have_the_asked_scale_ratio(ratio: float) -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (3, 50)) * [[1.0], [0.75], [0.1]]
    distance = np.linalg.norm(x - scenes._inversion_centre(x, ratio, rng)[:, None], axis=0)
    assert (distance.max() / distance.min()) ** 2 == pytest.approx(ratio)


def test_an_inversion_without_scale_change_is_refused() -> None:
    with pytest.raises(InputError, match=r"at least 1\.01"):
        moebius(scale_ratio=(1.0, 1.0))


def test_moebius_chords_scale_with_the_mean_of_their_ends() -> None:
    """|x' - y'| = sqrt(s_x s_y) |x - y|: discrete conformal equivalence is exact for Moebius maps."""
    scene = moebius()
    points, scale = scene.tracks.points, scene.conformal_scale(np.array([[3, 0]]))[0]
    chord = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=-1)
    np.testing.assert_allclose(chord[3], np.sqrt(scale[1:] * scale[:-1]) * chord[0], rtol=1e-10)


def test_mixed_scenes_are_isometric_in_even_frames_only() -> None:
    scene = mixed(n_points=80)
    np.testing.assert_allclose(scene.conformal_scale(np.array([[0, 2], [4, 8]])), 1.0, rtol=1e-12)
    assert np.ptp(np.log(scene.conformal_scale(np.array([[1, 0], [3, 0]]))), axis=1).min() > np.log(1.3)


def test_a_surface_seen_from_behind_is_refused() -> None:
    s, t = Jet.variables(*np.random.default_rng(0).uniform(-0.1, 0.1, (2, 5)))
    with pytest.raises(InputError, match="surface 0 of the synthetic scene does not face the camera"):
        Scene.of([Jet.stack([-s, t, 0.0 * s + 2.0])])


def test_inversion_about_the_camera_centre_is_not_observable() -> None:
    """X -> X / |X|^2 in one frame keeps its sight rays, and keeps it conformal to all others.

    The image, the warps, the metric rows and the discrete conformal residuals stay what they are, while the shape
    changes: conformal constraints alone have two solutions per frame. Isometry tells them apart.
    """
    scene, frame = moebius(), 2
    surface = scene.surfaces[frame]
    inverted = surface / surface.squared_norm()
    other = Scene.of([inverted if f == frame else s for f, s in enumerate(scene.surfaces)])
    np.testing.assert_allclose(other.image, scene.image, atol=1e-14)
    edges = chain(scene)
    np.testing.assert_allclose(other.jets(edges).jacobian, scene.jets(edges).jacobian, atol=1e-11)
    np.testing.assert_allclose(other.jets(edges).hessian, scene.jets(edges).hessian, atol=1e-9)
    assert np.abs(pair_rows(other, edges)[..., 18:]).max() < 1e-12
    # phi -> phi - 2 log |X|, and r = log |x_i - x_k| - l_ik - (phi_i + phi_k) / 2 stays.
    distance = np.linalg.norm(scene.tracks.points[frame], axis=-1)
    np.testing.assert_allclose(other.log_size[frame], scene.log_size[frame] - 2 * np.log(distance), atol=1e-12)
    residual = [
        np.log(np.linalg.norm(np.diff(s.tracks.points[frame], axis=0), axis=-1))
        - 0.5 * (s.log_size[frame, 1:] + s.log_size[frame, :-1])
        for s in (scene, other)
    ]
    np.testing.assert_allclose(residual[1], residual[0], atol=1e-11)
    assert np.ptp(other.log_size[frame] - scene.log_size[frame]) > 0.1


def test_before_a_camera_at_rest_only_the_bending_varies() -> None:
    flat, bent = (isometric_bending(4, 30, bend=bend, at_rest=True, seed=3).tracks.points for bend in (1e-5, 0.8))
    assert flat is not None
    assert bent is not None
    assert np.ptp(flat, axis=0).max() < 1e-3
    assert np.ptp(bent, axis=0).max() > 0.1
    centred = bent - bent.mean(axis=1, keepdims=True)
    turned = [Rotation.align_vectors(view, centred[0])[0].magnitude() for view in centred]
    assert np.degrees(max(turned)) < 10.0
