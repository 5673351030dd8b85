"""Numerical verification of Theorem 1: connections transform exactly when first- and second-order terms are used.

Ten pairs of balls related by a similarity (random radii, positions and rotations), 100 points each, exact image warps.
The index of a point is 100 |A - B| / (|A| + |B|), between 0 and 100 %, where A and B are the two sides of the theorem,

    A_k = J3 Lambda Gamma_k(a) Lambda^-1,    B_k = (Gamma_1(b) J_1k + Gamma_2(b) J_2k) J3 + dJ3/dx_k,

both directions k together, in unit-depth frames so that neither side depends on the depth's unit. It is computed twice:
with the true first-order terms only, the second-order ones set to zero, and with both true.

    python -m experiments.theorem --out DIR

prints the table and writes theorem.csv (one line per pair and point), theorem.md and theorem.png. Needs matplotlib.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.synthetic import Scene, spheres
from factors.conformal_pair import residuals
from factors.surface import connections

EDGE = np.array([[0, 1]])
COLUMNS = ("first order only", "first and second order")


def index_percent(scene: Scene, second_order: np.ndarray) -> np.ndarray:
    """Index (P,) of the first edge of a scene, in percent, for second-order terms (F, P, 3)."""
    image, first = scene.image, scene.first_order
    jet = scene.jets(EDGE)
    y = np.concatenate([first, second_order], axis=-1)
    log_rho = np.log(scene.conformal_scale(EDGE)[0]) + scene.log_depth[1] - scene.log_depth[0]
    rows = residuals(jet.pair_data(image[:1], image[1:])[0], y[0], y[1], log_rho)
    difference = rows[:, :18].reshape(-1, 2, 3, 3)
    # A from its definition, with rho in place of lambda in unit-depth frames; conjugating by diag(1, 1, rho) is enough.
    J3 = np.zeros((len(log_rho), 3, 3))
    J3[:, :2, :2] = jet.jacobian[0]
    J3[:, 2, 2] = np.linalg.det(jet.jacobian[0])
    rho = np.exp(log_rho)[:, None] ** [0.0, 0.0, 1.0]
    A = J3[:, None] @ (connections(image[0], first[0], second_order[0]) * rho[:, None, :, None] / rho[:, None, None])
    B = A - difference

    def size(matrices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(matrices.reshape(len(matrices), -1), axis=1)

    return 100.0 * size(difference) / (size(A) + size(B))


def verify(n_pairs: int = 10, n_points: int = 100, seed: int = 0) -> np.ndarray:
    """Index (n_pairs, n_points, 2) in percent: with first-order terms only, and with both orders."""
    pairs = [spheres(n_frames=2, n_points=n_points, seed=seed + k) for k in range(n_pairs)]
    return np.array(
        [
            np.stack([index_percent(scene, 0 * scene.second_order), index_percent(scene, scene.second_order)], axis=-1)
            for scene in pairs
        ]
    )


def table(index: np.ndarray) -> str:
    """Mean and maximum over the points of every pair, and over all."""
    lines = [f"{'index in percent':<16}" + "".join(f"{name:>34}" for name in COLUMNS)]
    lines += [f"{'pair':<16}" + f"{'mean':>20}{'max':>14}" * len(COLUMNS)]
    for name, values in [*((str(k), pair) for k, pair in enumerate(index)), ("all", index.reshape(-1, len(COLUMNS)))]:
        figures = (
            f"{value:>{width}.3g}" for column in values.T for value, width in ((column.mean(), 20), (column.max(), 14))
        )
        lines.append(f"{name:<16}" + "".join(figures))
    return "\n".join(lines)


def write_csv(index: np.ndarray, path: Path) -> None:
    """One line per pair and point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["pair", "point", *(f"index_percent, {name}" for name in COLUMNS)])
        for pair, points in enumerate(index):
            writer.writerows([pair, point, *(f"{value:.6e}" for value in row)] for point, row in enumerate(points))


def write_plot(index: np.ndarray, path: Path) -> None:
    """The spread of the index over the points of every pair, on a logarithmic scale."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.0), constrained_layout=True)
    for column, (name, colour) in enumerate(zip(COLUMNS, ("tab:orange", "tab:blue"), strict=True)):
        values = np.maximum(index[..., column].T, 1e-16)  # an exact zero has no place on a logarithmic axis
        box: dict[str, Any] = {
            "boxprops": {"facecolor": colour},
            "medianprops": {"color": "black"},
            "flierprops": {"markersize": 2},
        }
        axes.boxplot(values, positions=np.arange(len(index)), patch_artist=True, widths=0.5, label=name, **box)
    axes.set(yscale="log", xlabel="pair of balls", ylabel="index of the connections, percent")
    axes.set_title("Theorem 1 on balls related by similarities")
    axes.legend()
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for theorem.csv, .md and .png")
    parser.add_argument("--pairs", type=int, default=10, help="number of ball pairs")
    parser.add_argument("--points", type=int, default=100, help="points on each pair")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    index = verify(options.pairs, options.points, options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(index, options.out / "theorem.csv")
    write_plot(index, options.out / "theorem.png")
    text = f"### Theorem 1 on ball pairs\n\n```\n{table(index)}\n```\n"
    (options.out / "theorem.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
