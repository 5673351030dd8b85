"""Views declared isometric fix the conformal scales of all views of a sheet under Moebius maps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, refine
from connrsfm_graph.synthetic import Scene, isometric_bending, moebius


def scene_with_a_rigid_pair() -> Scene:
    """Moebius images of a sheet; view 1 is view 0, seen from elsewhere."""
    surfaces = list(moebius(n_frames=5, n_points=80).surfaces)
    middle = surfaces[0].value.mean(axis=1)[:, None]
    turned = (surfaces[0] - middle).rotated(Rotation.from_euler("xyz", (20, -15, 40), degrees=True).as_matrix())
    surfaces[1] = turned + 1.3 * middle
    return Scene.of(surfaces)


def test_declared_views_decide_all_scales():
    scene = scene_with_a_rigid_pair()
    start = scene.log_depth.mean(axis=1, keepdims=True) + 0.5 * (
        scene.log_depth - scene.log_depth.mean(axis=1, keepdims=True)
    )
    config = RefineConfig(model="conformal", isometric_views=(0, 1), uncertainty=False)
    found = refine(scene.image, scene.tracks.visible, start, config, 1e-6)
    assert evaluate(found.points, scene.tracks.points).e3d_percent < 0.1
    assert not found.ambiguous.any()
    assert found.alternative is None
    for a in range(2, 5):
        recovered = found.log_factor[a] - found.log_factor[0]
        assert np.corrcoef(recovered, scene.log_size[a] - scene.log_size[0])[0, 1] > 0.99


@pytest.mark.parametrize(
    ("views", "message"),
    [((3,), "isometric_views names one view"), ((0, 9), "names view 9, expected 0 to 3")],
)
def test_bad_declarations_are_named(views, message):
    scene = isometric_bending(n_frames=4, n_points=20)
    with pytest.raises(InputError, match=message):
        refine(scene.image, scene.tracks.visible, scene.log_depth, RefineConfig(isometric_views=views), 1e-3)
