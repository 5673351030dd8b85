"""The paper's synthetic data sets: spheres related by similarities, and isometric mixed with conformal images; spheres
and bent sheets seen by orthographic cameras; bent sheets before a camera at rest, whose slants tracks hardly tell; and
scenes of many kinds, in which all else is random.

Published figures belong to the paper's own random scenes, of which only the description is public.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from connrsfm_graph.config import override
from connrsfm_graph.synthetic import isometric_bending, mixed, spheres, varied, with_noise
from connrsfm_graph.synthetic.scene import Scene
from connrsfm_graph.synthetic.variety import KINDS
from connrsfm_graph.tracks import Tracks
from experiments.study import VARIANTS, Case, Experiment, Options
from factors.surface import ORTHOGRAPHIC


def tracks_of(scene: Callable[..., Scene], seed: int) -> Tracks:
    """The tracks of a synthetic scene by its maker and seed."""
    return scene(seed=seed).tracks


def data_set_1(options: Options) -> Callable[..., Scene]:
    """Maker of the paper's first data set, of a smaller one for a quick run."""
    return partial(spheres, n_frames=4, n_points=40) if options.quick else spheres


def _all_methods(scene: Callable[..., Scene], options: Options) -> Iterable[Case]:
    for seed in options.seeds():
        for name, (method, config) in VARIANTS.items():
            yield Case({"method": name, "seed": seed}, partial(tracks_of, scene, seed), method, config)


def _spheres(options: Options) -> Iterable[Case]:
    return _all_methods(data_set_1(options), options)


def _mixed(options: Options) -> Iterable[Case]:
    return _all_methods(partial(mixed, n_frames=4, n_points=40) if options.quick else mixed, options)


SPHERES = Experiment(
    "spheres",
    "Synthetic 1: 7 images of spheres related by similarities, 100 points",
    _spheres,
    published={("paper mode",): "0.81"},
)
MIXED = Experiment("mixed", "Synthetic 2: 10 images, isometric and conformal", _mixed)


def _orthographic(options: Options) -> Iterable[Case]:
    """Ours only: the baselines are for perspective cameras."""
    size = {"n_frames": 4, "n_points": 40} if options.quick else {"n_frames": 7, "n_points": 100}
    scenes: dict[str, Callable[..., Scene]] = {
        "spheres": spheres,
        "bending": isometric_bending,
        "bending, smooth": partial(isometric_bending, smooth=True),
    }
    for name, scene in scenes.items():
        maker = partial(scene, camera=ORTHOGRAPHIC, **size)
        for seed in options.seeds():
            for mode in ("default", "paper mode"):
                method, config = VARIANTS[mode]
                yield Case(
                    {"data": name, "method": mode, "seed": seed}, partial(tracks_of, maker, seed), method, config
                )


ORTHOGRAPHIC_SCENES = Experiment(
    "orthographic", "Orthographic cameras: 7 images, 100 points, up to one mirror image in depth", _orthographic
)

BENDS = (0.1, 0.2, 0.4, 0.8)
"""Largest curvature of the sheets before a camera at rest, radians over half their width."""


def _noisy_at_rest(size: tuple[int, int], bend: float, seed: int) -> Tracks:
    return with_noise(isometric_bending(*size, bend=bend, at_rest=True, seed=seed).tracks, 1.0, seed)


def _at_rest(options: Options) -> Iterable[Case]:
    """All methods, and the default without its prior on slants."""
    size = (5, 40) if options.quick else (15, 100)
    method, config = VARIANTS["default"]
    without = {"default without the prior": (method, override(config, ["refine.frontal_patches=[]"]))}
    for bend in BENDS[1:2] if options.quick else BENDS:
        for name, (method, config) in {"default": VARIANTS["default"], **without, **VARIANTS}.items():
            for seed in options.seeds():
                keys = {"bend": bend, "method": name, "seed": seed}
                yield Case(keys, partial(_noisy_at_rest, size, bend, seed), method, config)


AT_REST = Experiment(
    "at_rest", "A sheet that bends before a camera at rest: 15 images, 100 points, 1 px noise", _at_rest, x="bend"
)


def _variety(options: Options) -> Iterable[Case]:
    for kind in list(KINDS)[1:2] if options.quick else KINDS:
        for seed in options.seeds():
            for name, (method, config) in VARIANTS.items():
                yield Case({"kind": kind, "method": name, "seed": seed}, partial(varied, kind, seed), method, config)


VARIETY = Experiment("variety", "Scenes of many kinds, all else at random", _variety)
