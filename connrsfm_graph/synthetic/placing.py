"""What scenes are made of: the flat sheet and its rolls, surfaces placed before the camera, smooth motion.

Frames are drawn at random until their surface faces the camera everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.scene import FOCAL_LENGTH, HEIGHT, WIDTH, facing
from factors.surface import PERSPECTIVE, Camera

LEAST_FACING = 0.1
"""Points keep about 6 degrees from the horizon, where no tracker would hold them."""
HALF_FIELD = np.array([WIDTH, HEIGHT]) / (2 * FOCAL_LENGTH)
"""Half the field of view in normalised image coordinates."""
SHEET = np.array([1.0, 0.75])
"""Half-sides of the flat sheet."""


def flat_sheet(n_points: int, rng: np.random.Generator) -> tuple[Jet, Jet]:
    """Random points of the flat sheet, whose two coordinates all surfaces are functions of."""
    s, t = (rng.uniform(-1.0, 1.0, (n_points, 2)) * SHEET).T
    return Jet.variables(s, t)


def rolled(sheet: tuple[Jet, Jet], curvature: float, axis: float) -> Jet:
    """The sheet rolled to a cylinder: isometric. `axis` is the direction of rolling in the sheet, in radians."""
    curvature = curvature if abs(curvature) > 1e-6 else 1e-6  # flat to within the rounding of the formulas
    s, t = sheet
    along = s * np.cos(axis) + t * np.sin(axis)
    across = t * np.cos(axis) - s * np.sin(axis)
    sagitta = (along * (0.5 * curvature)).sin()
    rolled = Jet.stack([(along * curvature).sin() / curvature, across, sagitta * sagitta * (2.0 / curvature)])
    return rolled.rotated(Rotation.from_rotvec([0.0, 0.0, axis]).as_matrix())


def placed(surface: Jet, motion: np.ndarray, tilt_deg: float, fill: tuple[float, float]) -> Jet:
    """The surface turned and moved in front of the camera: spin (up to 60 degrees), tilt, lateral shift, distance.

    Args:
        surface: facing the camera, any place.
        motion: (6,) numbers in [-1, 1].
        tilt_deg: largest tilt about either image axis.
        fill: range of the share of the field of view that the surface fills, which sets its distance.
    """
    tilt = np.radians(tilt_deg) * motion[:2]
    turn = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, np.radians(60.0) * motion[2]])
    turned = (surface - surface.value.mean(axis=1)[:, None]).rotated(turn.as_matrix())
    shift = 0.2 * motion[3:5] * np.linalg.norm(turned.value, axis=0).max()
    half = HALF_FIELD * np.interp(motion[5], (-1.0, 1.0), fill)
    x, y, z = turned.value
    distance = np.maximum(np.abs(x + shift[0]) / half[0], np.abs(y + shift[1]) / half[1]) - z
    return turned + np.array([*shift, distance.max()])[:, None]


def smooth_motion(n_frames: int, n_series: int, rng: np.random.Generator) -> np.ndarray:
    """(F, n_series) random sums of three slow waves, each series within [-1, 1]."""
    time = np.arange(n_frames)[:, None, None] / max(n_frames, 2)
    wave = np.sin(2 * np.pi * (rng.uniform(0.25, 1.0, (n_series, 3)) * time + rng.uniform(0.0, 1.0, (n_series, 3))))
    return (wave * rng.dirichlet(np.ones(3), n_series)).sum(axis=-1)


def facing_draw(draw: Callable[[], Jet], camera: Camera = PERSPECTIVE) -> Jet:
    """Draw until the surface faces the camera everywhere."""
    return facing_draws(lambda: [draw()], camera)[0]


def facing_draws(draw: Callable[[], list[Jet]], camera: Camera = PERSPECTIVE) -> list[Jet]:
    """Draw until every surface faces the camera everywhere."""
    for _ in range(1000):
        surfaces = draw()
        if all(facing(surface, camera).min() > LEAST_FACING for surface in surfaces):
            return surfaces
    raise InputError("no frame of the synthetic scene faces the camera everywhere; ask for a flatter surface")
