"""Surface geometry against analytic surfaces and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors.surface import (
    CAMERAS,
    ORTHOGRAPHIC,
    PERSPECTIVE,
    connections,
    first_order_from_normals,
    metric,
    moving_frame,
    normals,
    planar_second_order,
)

SMALL = st.floats(-0.8, 0.8)


def _frame_near(image, y, step, camera):
    """Moving frame at image + step of the surface whose depth has the Taylor coefficients y at depth 1."""
    du, dv = step
    depth = 1 + y[0] * du + y[1] * dv + 0.5 * (y[2] * du * du + 2 * y[3] * du * dv + y[4] * dv * dv)
    slope = np.array([y[0] + y[2] * du + y[3] * dv, y[1] + y[3] * du + y[4] * dv])
    return moving_frame(image + step, slope / depth if camera.kappa else slope, depth, camera)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@given(values=st.lists(SMALL, min_size=7, max_size=7))
def test_connections_are_the_logarithmic_derivative_of_the_frame(camera, values):
    image, y = np.array(values[:2]), np.array(values[2:])
    h = 1e-6
    for k, step in enumerate(np.eye(2) * h):
        change = (_frame_near(image, y, step, camera) - _frame_near(image, y, -step, camera)) / (2 * h)
        expected = np.linalg.solve(_frame_near(image, y, np.zeros(2), camera), change)
        assert connections(image, y[:2], y[2:], camera)[k] == pytest.approx(
            expected, abs=1e-6 * (1 + abs(expected).max())
        )


def test_frame_is_the_derivative_of_the_surface():
    # A sphere of radius 2 about (0.3, -0.2, 6): depth along the ray (u, v, 1) in closed form.
    centre, radius = np.array([0.3, -0.2, 6.0]), 2.0

    def surface(u, v):
        ray = np.array([u, v, 1.0])
        a, b = ray @ ray, ray @ centre
        return ray * (b - np.sqrt(b * b - a * (centre @ centre - radius**2))) / a

    u, v, h = 0.05, -0.1, 1e-6
    depth = surface(u, v)[2]
    tangents = np.stack(
        [(surface(u + h, v) - surface(u - h, v)) / (2 * h), (surface(u, v + h) - surface(u, v - h)) / (2 * h)], axis=-1
    )
    first_order = tangents[2] / depth
    frame = moving_frame(np.array([u, v]), first_order, depth)
    assert frame[:, :2] == pytest.approx(tangents, abs=1e-7)
    assert frame[:, 2] == pytest.approx(np.cross(*tangents.T), abs=1e-6)
    assert metric(np.array([u, v]), first_order, depth) == pytest.approx(tangents.T @ tangents, abs=1e-6)
    outward = (surface(u, v) - centre) / radius
    assert normals(np.array([u, v]), first_order) == pytest.approx(outward, abs=1e-7)


@given(st.lists(SMALL, min_size=4, max_size=4))
def test_normals_and_first_order_terms_are_inverse(values):
    image, first_order = np.array(values[:2]), np.array(values[2:])
    for camera in CAMERAS.values():
        normal = normals(image, first_order, camera)
        assert np.linalg.norm(normal) == pytest.approx(1)
        towards = -np.append(camera.rays(image), 1.0)
        assert normal @ towards > 0
        assert first_order_from_normals(image, normal, camera) == pytest.approx(first_order, abs=1e-9)


@given(st.lists(SMALL, min_size=4, max_size=4))
def test_plane_has_no_second_fundamental_form(values):
    image, first_order = np.array(values[:2]), np.array(values[2:])
    for camera in CAMERAS.values():
        G = connections(image, first_order, planar_second_order(first_order, camera), camera)
        assert G[:, 2, :2] == pytest.approx(0, abs=1e-12)
        assert G[:, :2, 2] == pytest.approx(0, abs=1e-12)


def test_points_of_both_cameras():
    image, depth = np.array([[0.1, -0.2]]), np.array([5.0])
    assert PERSPECTIVE.points(image, depth) == pytest.approx(np.array([[0.5, -1.0, 5.0]]))
    assert ORTHOGRAPHIC.points(image, depth) == pytest.approx(np.array([[0.1, -0.2, 5.0]]))
