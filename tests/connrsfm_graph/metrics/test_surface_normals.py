from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import integrate
from scipy.interpolate import BSpline

from connrsfm_graph.metrics import surface_normals as module
from connrsfm_graph.metrics.surface_normals import RECONSTRUCTION, TRUTH, surface_normals


def sphere_cap(n: int, half_angle_deg: float = 35.0) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals of a cap of a unit sphere around (0, 0, 4) that faces the camera."""
    rng = np.random.default_rng(0)
    height = rng.uniform(np.cos(np.radians(half_angle_deg)), 1.0, n)
    turn = rng.uniform(0.0, 2 * np.pi, n)
    across = np.sqrt(1 - height**2)
    normals = np.stack([across * np.cos(turn), across * np.sin(turn), -height], axis=-1)
    return normals + np.array([0.0, 0.0, 4.0]), normals


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0)))


@pytest.mark.parametrize(("refit", "bound_deg"), [(RECONSTRUCTION, 1.5), (TRUTH, 0.5)])
def test_normals_of_a_sphere(refit: module.Refit, bound_deg: float) -> None:
    points, normals = sphere_cap(400)
    found = surface_normals(points[:, :2] / points[:, 2:], points, refit)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    assert degrees(found, normals).mean() < bound_deg


def test_the_refit_converges_to_the_surface() -> None:
    """Bending is weighed against the sum over points, so more points leave less of its bias."""
    errors = []
    for n in (100, 400, 1600):
        points, normals = sphere_cap(n)
        errors.append(degrees(surface_normals(points[:, :2] / points[:, 2:], points, RECONSTRUCTION), normals).mean())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.5


def test_normals_of_a_plane_are_exact() -> None:
    """An affine map has no bending energy; over its own projections a plane facing the camera is affine."""
    image = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 2))
    tilted = np.column_stack([image, 2.0 + 0.3 * image[:, 0] - 0.2 * image[:, 1]])
    found = surface_normals(image, tilted, RECONSTRUCTION)
    np.testing.assert_allclose(found, np.tile(np.array([0.3, -0.2, -1.0]) / np.sqrt(1.13), (50, 1)), atol=1e-9)


def test_bending_energy_equals_its_integral() -> None:
    """Against SciPy's splines and numerical integration of one product of basis functions."""
    n, step = module.CONTROL_POINTS, np.array([0.02, 0.03])
    knots = [h * np.arange(-3.0, n + 1.0) for h in step]
    i, j, k, m = 5, 7, 6, 5

    def integral(axis: int, a: int, b: int, order: int) -> float:
        first, second = (
            BSpline.basis_element(knots[axis][c : c + 5], extrapolate=False).derivative(order)
            if order
            else BSpline.basis_element(knots[axis][c : c + 5], extrapolate=False)
            for c in (a, b)
        )
        lower, upper = knots[axis][max(a, b)], knots[axis][min(a, b) + 4]
        breaks = np.arange(lower, upper + step[axis] / 2, step[axis])
        return sum(
            integrate.quad(lambda x: float(first(x) * second(x)), p + 1e-12, q - 1e-12)[0]
            for p, q in itertools.pairwise(breaks)
        )

    expected = (
        integral(0, i, j, 2) * integral(1, k, m, 0)
        + 2 * integral(0, i, j, 1) * integral(1, k, m, 1)
        + integral(0, i, j, 0) * integral(1, k, m, 2)
    )
    assert module._bending_energy(step)[[i * n + k], [j * n + m]][0] == pytest.approx(expected, rel=1e-6)
