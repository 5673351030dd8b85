"""The synthetic scenes: spheres, bent sheets, Moebius images, and sheets mixed with Moebius images.

Each draws its frames at random from a seed.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.placing import facing_draw, facing_draws, flat_sheet, placed, rolled, smooth_motion
from connrsfm_graph.synthetic.scene import Scene, inward_normal
from factors.surface import PERSPECTIVE, Camera


def spheres(
    n_frames: int = 7,
    n_points: int = 100,
    half_angle_deg: float = 35.0,
    seed: int = 0,
    camera: Camera = PERSPECTIVE,
) -> Scene:
    """Caps of spheres related by similarities x -> s R x + t (the paper's verification and first data set).

    Args:
        n_frames, n_points: F and P.
        half_angle_deg: angle between the axis of the cap and its rim.
        seed: of points, radii (0.5 to 2), rotations and positions.
        camera: of all frames.
    """
    rng = np.random.default_rng(seed)
    across = np.sqrt(1.0 - rng.uniform(np.cos(np.radians(half_angle_deg)), 1.0, n_points) ** 2)
    turn = rng.uniform(0.0, 2 * np.pi, n_points)
    s, t = Jet.variables(across * np.cos(turn), across * np.sin(turn))
    cap = Jet.stack([s, t, -((1.0 - s * s - t * t) ** 0.5)])

    def draw() -> Jet:
        return placed(cap * rng.uniform(0.5, 2.0), rng.uniform(-1.0, 1.0, 6), tilt_deg=30.0, fill=(0.6, 0.95))

    return Scene.of([facing_draw(draw, camera) for _ in range(n_frames)], camera)


def isometric_bending(
    n_frames: int = 10,
    n_points: int = 100,
    bend: float = 0.8,
    smooth: bool = False,
    at_rest: bool = False,
    seed: int = 0,
    camera: Camera = PERSPECTIVE,
) -> Scene:
    """A sheet rolled to cylinders of varying radius and axis, moved rigidly: isometric, not similar.

    Args:
        n_frames, n_points: F and P.
        bend: largest curvature, in radians over half the sheet's width.
        smooth: whether frames follow one another in a smooth motion, as in a video, or are drawn independently.
        at_rest: whether frames that are drawn independently have their pose in common, as before a camera at rest.
        seed: of points and motion.
        camera: of all frames.
    """
    rng = np.random.default_rng(seed)
    sheet = flat_sheet(n_points, rng)

    def draw(motion: np.ndarray) -> Jet:
        return placed(rolled(sheet, bend * motion[0], np.pi * motion[1]), motion[2:], tilt_deg=25.0, fill=(0.75, 1.0))

    if at_rest:
        pose = rng.uniform(-1.0, 1.0, 6)
        surfaces = [facing_draw(lambda: draw(np.r_[rng.uniform(-1.0, 1.0, 2), pose]), camera) for _ in range(n_frames)]
    elif not smooth:
        surfaces = [facing_draw(lambda: draw(rng.uniform(-1.0, 1.0, 8)), camera) for _ in range(n_frames)]
    else:
        surfaces = facing_draws(lambda: [draw(motion) for motion in smooth_motion(n_frames, 8, rng)], camera)
    return Scene.of(surfaces, camera)


def moebius(
    n_frames: int = 9, n_points: int = 150, scale_ratio: tuple[float, float] = (1.5, 2.5), seed: int = 0
) -> Scene:
    """One wavy sheet under random inversions of space and similarities: conformal, neither isometric nor similar.

    Args:
        n_frames, n_points: F and P.
        scale_ratio: range of the ratio of the largest to the smallest local scale over the patch, one draw per frame.
        seed: of points, sheet and maps.
    """
    rng = np.random.default_rng(seed)
    s, t = flat_sheet(n_points, rng)
    waves = [(rng.uniform(-2.5, 2.5, 2), rng.uniform(0.0, 2 * np.pi)) for _ in range(3)]
    relief = sum(((s * k[0] + t * k[1] + phase).sin() * 0.08 for k, phase in waves), start=0.0 * s)
    sheet = Jet.stack([s, t, relief])
    return Scene.of([facing_draw(lambda: _moebius_image(sheet, scale_ratio, rng)) for _ in range(n_frames)])


def mixed(
    n_frames: int = 10, n_points: int = 600, scale_ratio: tuple[float, float] = (1.5, 2.5), seed: int = 0
) -> Scene:
    """Even frames: isometric bendings of one sheet. Odd frames: Moebius images of such bendings (the paper's second
    data set mixes isometric and conformal deformations likewise). Arguments as in `isometric_bending` and `moebius`."""
    rng = np.random.default_rng(seed)
    sheet = flat_sheet(n_points, rng)

    def draw(frame: int) -> Jet:
        bent = rolled(sheet, rng.uniform(-0.8, 0.8), rng.uniform(-np.pi, np.pi))
        if frame % 2 == 0:
            return placed(bent, rng.uniform(-1.0, 1.0, 6), tilt_deg=25.0, fill=(0.75, 1.0))
        return _moebius_image(bent, scale_ratio, rng)

    return Scene.of([facing_draw(partial(draw, f)) for f in range(n_frames)])


def _moebius_image(surface: Jet, scale_ratio: tuple[float, float], rng: np.random.Generator) -> Jet:
    """Image under an inversion whose centre lies in a random direction, as far away as the scale ratio asks for."""
    offset = surface - _inversion_centre(surface.value, rng.uniform(*scale_ratio), rng)[:, None]
    # Inversion turns space inside out; a reflection turns it back.
    image = offset.rotated(np.diag([1.0, 1.0, -1.0])) / offset.squared_norm()
    image = image * (1.0 / np.linalg.norm(image.value - image.value.mean(axis=1, keepdims=True), axis=0).max())
    inward = inward_normal(image).mean(axis=1)
    upright, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [inward])
    return placed(image.rotated(upright.as_matrix()), rng.uniform(-1.0, 1.0, 6), tilt_deg=25.0, fill=(0.75, 1.0))


def _inversion_centre(x: np.ndarray, scale_ratio: float, rng: np.random.Generator) -> np.ndarray:
    """Centre (3,) whose inversion scales the points x (3, P), by 1 / distance^2, with the given ratio."""
    if scale_ratio < 1.01:
        raise InputError(f"the scale ratio of a Moebius image must be at least 1.01, got {scale_ratio:.4g}")
    middle = x.mean(axis=1)
    radius = np.linalg.norm(x - middle[:, None], axis=0).max()

    def excess(distance: float) -> float:
        squared = ((x - (middle + distance * direction)[:, None]) ** 2).sum(axis=0)
        return float(np.log(squared.max() / squared.min() / scale_ratio))

    while True:
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        # Seen along its normal a sheet is about equally far everywhere: not every direction allows every ratio.
        if excess(1.01 * radius) > 0:
            return middle + direction * brentq(excess, 1.01 * radius, 1000.0 * radius)
