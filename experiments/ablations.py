"""Ablations, all from configuration: stages, rounds of the schedule, starting values, image pairs and sigmas."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial

from connrsfm_graph.reconstruct import Config, default_config
from connrsfm_graph.tracks import Tracks, load_tracks
from experiments.real import spoilt
from experiments.study import Case, Experiment, Options
from experiments.synthetic import data_set_1, tracks_of
from factors.noise import PairNoise

PAPER, DEFAULT = default_config("paper"), default_config()
FROM_WARPS = replace(DEFAULT, solve=replace(DEFAULT.solve, sigmas="warps"))
LEVELS = {
    "pre-step alone": replace(PAPER, solve=replace(PAPER.solve, schedule="none")),
    "paper mode without pre-step": replace(PAPER, start="zeros"),
    "paper mode": PAPER,
    "joint, all rows": replace(DEFAULT, solve=replace(DEFAULT.solve, noise=PairNoise()), refinement=False),
    "joint, metric rows": replace(
        DEFAULT, solve=replace(DEFAULT.solve, noise=PairNoise(1.0, math.inf, math.inf)), refinement=False
    ),
    "joint, no second-order rows": replace(
        DEFAULT, solve=replace(DEFAULT.solve, noise=replace(DEFAULT.solve.noise, extrinsic=math.inf)), refinement=False
    ),
    "joint": replace(DEFAULT, refinement=False),
    "joint, sigmas from the warps": replace(FROM_WARPS, refinement=False),
    "pre-step, refined": replace(DEFAULT, solve=replace(DEFAULT.solve, schedule="none")),
    "default, isometric model": replace(DEFAULT, refine=replace(DEFAULT.refine, model="isometric")),
    "default, conformal model": replace(DEFAULT, refine=replace(DEFAULT.refine, model="conformal")),
    "default": DEFAULT,
    "default, sigmas from the warps": FROM_WARPS,
}
"""From the pre-step alone to everything."""
ROUNDS = {str(n): replace(PAPER, solve=replace(PAPER.solve, outer_iterations=n)) for n in range(1, 6)}
STARTS = {
    f"{mode}, {start}": replace(config, start=start)
    for mode, config in (("paper mode", PAPER), ("default", DEFAULT))
    for start in ("pre-step", "zeros", "ones", "random")
}
PAIRS = {
    f"{mode}, {extra}": replace(config, graph=replace(config.graph, extra_per_frame=extra))
    for mode, config in (("paper mode", PAPER), ("default", DEFAULT))
    for extra in (0.0, 0.5, 1.0, 2.0, 4.0)
}

SIGMAS = {
    "pre-step": replace(DEFAULT, solve=replace(DEFAULT.solve, schedule="none"), refinement=False),
    "fixed": replace(DEFAULT, refinement=False),
    "from the warps": replace(FROM_WARPS, refinement=False),
}
REAL = {
    "T-shirt": ("tshirt.npz", 0, 0),
    "T-shirt, 20 px": ("tshirt.npz", 20, 0),
    "T-shirt, 50 px": ("tshirt.npz", 50, 0),
    "T-shirt, 50 % missing": ("tshirt.npz", 0, 50),
    "T-shirt, 70 % missing": ("tshirt.npz", 0, 70),
    "KinectPaper": ("kinect_paper.npz", 0, 0),
    "Flag": ("flag.npz", 0, 0),
    "Flag, 4 px": ("flag.npz", 4, 0),
}
"""File, noise in pixels and percent missing."""


def _sigmas(options: Options) -> Iterable[Case]:
    """Every kind of sigmas on spheres and on the real data sets; the random ones with every seed."""
    names = list(SIGMAS) if not options.quick else ["fixed", "from the warps"]
    sets: list[tuple[str, int, partial[Tracks]]] = []
    for seed in options.seeds():
        sets.append(("spheres", seed, partial(tracks_of, data_set_1(options), seed)))
    for data, (file, noise, missing) in ({} if options.quick else REAL).items():
        path = options.data / file
        for seed in (options.seeds() if noise or missing else [0]) if path.exists() else []:
            sets.append((data, seed, partial(spoilt, path, noise, missing, seed)))
    for data, seed, tracks in sets:
        for name in names:
            yield Case({"data": data, "sigmas": name, "seed": seed}, tracks, config=replace(SIGMAS[name], seed=seed))


def _data_sets(options: Options) -> Iterable[tuple[str, int, partial[Tracks]]]:
    """Spheres of every seed, and the T-shirt where it is and time allows."""
    for seed in options.seeds():
        yield "spheres", seed, partial(tracks_of, data_set_1(options), seed)
    if (options.data / "tshirt.npz").exists() and not options.quick:
        yield "T-shirt", 0, partial(load_tracks, options.data / "tshirt.npz")


def _cases(column: str, settings: Mapping[str, Config], options: Options) -> Iterable[Case]:
    """Every setting on every data set; the first and the last ones in a quick run."""
    chosen = list(settings.items())[:: len(settings) - 1 if options.quick else 1]
    for data, seed, tracks in _data_sets(options):
        for name, config in chosen:
            yield Case({"data": data, column: name, "seed": seed}, tracks, config=replace(config, seed=seed))


def _by_mode(column: str, settings: Mapping[str, Config], options: Options) -> Iterable[Case]:
    for case in _cases(column, settings, options):
        mode, value = str(case.keys[column]).split(", ")
        yield replace(case, keys={"data": case.keys["data"], "mode": mode, column: value, "seed": case.keys["seed"]})


ABLATION = Experiment("ablation", "What each stage adds", partial(_cases, "stages", LEVELS))
ITERATIONS = Experiment(
    "iterations", "Rounds N_t of the separable schedule, paper mode", partial(_cases, "N_t", ROUNDS), x="N_t"
)
STARTING_VALUES = Experiment(
    "starting_values", "First-order terms at the start", partial(_by_mode, "start", STARTS), x="start"
)
ROW_SIGMAS = Experiment("sigmas", "Sigmas of the pair factors' rows, before the refinement", _sigmas)
EDGES = Experiment(
    "edges",
    "Image pairs beside the spanning tree, per image",
    partial(_by_mode, "extra per image", PAIRS),
    x="extra per image",
)
