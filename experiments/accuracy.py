"""How accurate the defaults are, against what they are meant to reach: `python -m experiments.accuracy [ROW ...]`.

Every row is one kind of data. Three runs on the same tracks are compared: the default settings, the same without
refinement (what the refinement starts from) and the published algorithm (`--mode paper`). Random rows are means over
five seeds. Runs are kept in `accuracy.csv` and not repeated; the table of all rows also goes into the project's README,
between its two accuracy comments.

Normals of the truth are those of a spline on synthetic data, too, as they must be on real data.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.files import written_beside
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruct import Config, default_config, reconstruct
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.synthetic import Scene, mixed, moebius, spheres, with_missing, with_noise, with_outliers
from connrsfm_graph.tracks import Tracks, load_tracks
from experiments.study import FAILURE, SEED, Options, append_row, compile_kernels, read_rows
from experiments.verdict import DEFAULT, PAPER, RUNS, START, Target, table

README = Path(__file__).resolve().parents[1] / "README.md"
MARKS = ("<!-- accuracy -->", "<!-- /accuracy -->")
"""Comments of the README between which the table stands."""


@dataclass(frozen=True)
class Sample:
    """Tracks with truth, and what else is known of them."""

    tracks: Tracks
    scene: Scene | None = None
    """The synthetic scene, for its true conformal scale."""
    wrong: np.ndarray | None = None
    """(F, P) bool, wrong tracks."""


@dataclass(frozen=True, kw_only=True)
class Row(Target):
    """One kind of data, and what is to be reached on it."""

    sample: Callable[[Path, int], Sample]
    """Makes the data, from the folder of real data and a seed."""
    file: str | None = None
    """Name of the real data set."""
    random: bool = True
    """Whether it differs from seed to seed."""

    def config(self, run: str) -> Config:
        """Settings of one of the runs."""
        config = default_config("paper" if run == PAPER else "default")
        if run == START:
            return replace(config, refinement=False)
        return replace(config, refine=RefineConfig(isometric_views=self.isometric_views))


def _real(file: str, data: Path, seed: int, noise: float = 0.0, missing: float = 0.0, wrong: float = 0.0) -> Sample:
    tracks = with_noise(load_tracks(data / file), noise, seed)
    tracks = with_missing(tracks, missing, seed) if missing else tracks
    if not wrong:
        return Sample(tracks)
    tracks, mistaken = with_outliers(tracks, wrong, seed)
    return Sample(tracks, wrong=mistaken)


def _synthetic(make: Callable[..., Scene], data: Path, seed: int, missing: float = 0.0, **scene: float) -> Sample:
    made = make(seed=seed, **scene)
    return Sample(with_missing(made.tracks, missing, seed) if missing else made.tracks, made)


def _rigid_pair(seed: int) -> Scene:
    """Moebius images of a sheet of which view 1 is view 0, seen from elsewhere."""
    surfaces = list(moebius(seed=seed).surfaces)
    middle = surfaces[0].value.mean(axis=1)[:, None]
    turn = Rotation.from_euler("xyz", (20, -15, 40), degrees=True).as_matrix()
    surfaces[1] = (surfaces[0] - middle).rotated(turn) + 1.3 * middle
    return Scene.of(surfaces)


def _file(name: str, file: str, *conditions: tuple[str, dict[str, Any], tuple[float, float], str]) -> list[Row]:
    """Rows on a real data set: what is done to it, bound, best known elsewhere."""
    return [
        Row(
            name=f"{name}{', ' * bool(condition)}{condition}",
            sample=partial(_real, file, **spoilt),
            bound=bound,
            known=known,
            file=file,
            random=bool(spoilt),
            model=None if spoilt else "isometric",
            clean=name if "wrong" in spoilt else None,
        )
        for condition, spoilt, bound, known in conditions
    ]


def _scene(
    name: str,
    sample: Callable[[Path, int], Sample],
    bound: tuple[float, float],
    known: str,
    model: str | None = None,
) -> Row:
    return Row(name=name, sample=sample, bound=bound, known=known, model=model)


_ANY = (math.inf, math.inf)
ROWS: tuple[Row, ...] = (
    *_file(
        "T-shirt",
        "tshirt.npz",
        ("", {}, (0.30, 2.8), "0.48 / 3.7"),
        ("5 px", {"noise": 5}, (0.40, 3.6), ""),
        ("20 px", {"noise": 20}, (0.62, 5.5), "2.3 to 3"),
        ("50 px", {"noise": 50}, (1.2, 9.2), "2.3 to 3"),
        ("30 % missing", {"missing": 0.3}, (0.36, 3.1), ""),
        ("50 % missing", {"missing": 0.5}, (0.52, 4.1), "2.77 / 20.95"),
        ("70 % missing", {"missing": 0.7}, (1.5, 12.0), ""),
        ("10 % wrong", {"wrong": 0.1}, _ANY, ""),
    ),
    *_file(
        "KinectPaper",
        "kinect_paper.npz",
        ("", {}, (0.31, 2.8), "0.64 / 4.9"),
        ("10 % wrong", {"wrong": 0.1}, _ANY, ""),
    ),
    *_file(
        "Flag",
        "flag.npz",
        ("", {}, (0.21, 3.3), ""),
        ("1 px", {"noise": 1}, (0.36, 5.2), ""),
        ("2 px", {"noise": 2}, (0.50, 6.4), ""),
        ("4 px", {"noise": 4}, (1.0, 7.5), "1.54"),
    ),
    _scene("Spheres, 35 degrees", partial(_synthetic, spheres), (0.05, 1.1), "0.81 / 6.1"),
    _scene("Spheres, 55 degrees", partial(_synthetic, spheres, half_angle_deg=55.0), (0.05, 1.1), "1.4 / 11"),
    _scene("Spheres, 30 % missing", partial(_synthetic, spheres, missing=0.3), (0.05, math.inf), "1.74"),
    _scene("Spheres, 50 % missing", partial(_synthetic, spheres, missing=0.5), (0.10, math.inf), "1.86"),
    _scene("Spheres, 70 % missing", partial(_synthetic, spheres, missing=0.7), (0.38, math.inf), "2.39"),
    replace(
        _scene("Moebius, two views declared isometric", partial(_synthetic, _rigid_pair), (0.5, 5.0), "", "conformal"),
        isometric_views=(0, 1),
    ),
    _scene("Moebius", partial(_synthetic, moebius), (0.5, 5.0), "", "conformal"),
    _scene("Mixed, 600 points", partial(_synthetic, mixed), (1.0, 9.0), "1.12 / 9.6"),
)


def run(row: Row, name: str, seed: int, data: Path) -> dict[str, str]:
    """One run and its figures, as a line of the CSV; a failure is a result, too."""
    keys = {"row": row.name, "run": name, SEED: str(seed)}
    figures = dict.fromkeys(
        ("error", "shape", "floor", "alternative_error", "alternative_shape", "precision", "recall", "scale"), ""
    )
    sample = row.sample(data, seed)
    tracks, start = sample.tracks, time.perf_counter()
    assert tracks.points is not None, "an accuracy needs tracks with truth"
    try:
        result, record = reconstruct(tracks, row.config(name))
    except (ComputationError, InputError) as error:
        return keys | figures | {"model": "", "seconds": "", FAILURE: str(error)}
    seconds = time.perf_counter() - start
    found = evaluate(result.points, tracks.points, tracks.visible)
    values = {"error": found.e3d_percent, "shape": found.shape_error_deg, "floor": found.shape_floor_deg}
    if result.alternative is not None:
        other = evaluate(result.alternative, tracks.points, tracks.visible)
        values |= {"alternative_error": other.e3d_percent, "alternative_shape": other.shape_error_deg}
    if sample.wrong is not None and name == DEFAULT:
        hits = float((result.outlier & sample.wrong).sum())
        values |= {"precision": hits / max(result.outlier.sum(), 1), "recall": hits / sample.wrong.sum()}
    if sample.scene is not None:
        values["scale"] = scale_correlation(result, sample.scene)
    figures |= {key: f"{value:.4g}" for key, value in values.items()}
    return keys | figures | {"model": record.decisions.get("model", ""), "seconds": f"{seconds:.3g}", FAILURE: ""}


def scale_correlation(result: Reconstruction, scene: Scene) -> float:
    """Correlation of recovered and true log conformal scale over all edges; each edge's mean is a convention."""
    found, truth = np.log(result.conformal_scale), np.log(scene.conformal_scale(result.edges))
    truth = np.where(np.isfinite(found), truth, np.nan)
    found, truth = (values - np.nanmean(values, axis=1, keepdims=True) for values in (found, truth))
    known = np.isfinite(found)
    return float(np.corrcoef(found[known], truth[known])[0, 1])


def measure(options: Options, names: Sequence[str] = ()) -> None:
    """Run what is missing of the named rows, or of all, then write accuracy.md.

    A quick run takes the first row and one small synthetic one.
    """
    wanted = [row for row in ROWS if not names or row.name in names]
    if options.quick:
        wanted = [row for row in ROWS if row.name in ("T-shirt", "Spheres, 35 degrees")]
    absent = {row.file for row in wanted if row.file and not (options.data / row.file).exists()}
    for file in sorted(absent):
        print(f"accuracy: rows of {file} skipped, it is not in {options.data}", file=sys.stderr)
    wanted = [row for row in wanted if row.file not in absent]
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "accuracy.csv"
    lines = read_rows(path)
    done = {(line["row"], line["run"], line[SEED]) for line in lines}
    seeds = {row.name: options.seeds() if row.random else range(1) for row in ROWS}
    cases = [(row, name, seed) for row in wanted for seed in seeds[row.name] for name in RUNS]
    cases = [(row, name, seed) for row, name, seed in cases if (row.name, name, str(seed)) not in done]
    if cases:
        compile_kernels()
    for count, (row, name, seed) in enumerate(cases, 1):
        print(f"accuracy {count}/{len(cases)}: {row.name}, {name}, seed {seed}", end=" ", file=sys.stderr, flush=True)
        line = run(row, name, seed, options.data)
        append_row(path, line)
        lines.append(line)
        print(line[FAILURE] or f"{line['error']} / {line['shape']} in {line['seconds']} s", file=sys.stderr)
    runs: dict[tuple[str, str], list[Mapping[str, str]]] = {}
    for line in lines:
        if int(line[SEED]) in seeds.get(line["row"], ()):
            runs.setdefault((line["row"], line["run"]), []).append(line)
    text = table(wanted, runs)
    (options.out / "accuracy.md").write_text(text, encoding="utf-8")
    print(text)


def write_between_marks(readme: Path, text: str, marks: tuple[str, str] = MARKS) -> None:
    """Replace what stands between two comments of a Markdown file.

    Raises:
        InputError: the file does not hold both comments.
    """
    old = readme.read_text(encoding="utf-8")
    before, start, rest = old.partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not start or not end:
        raise InputError(f"{readme}: expected the comments {' and '.join(marks)}, between which the table goes")
    with written_beside(readme) as part:
        part.write_text(f"{before}{start}\n{text}{end}{after}", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.accuracy", description=(__doc__ or "").splitlines()[0].split(":")[0]
    )
    parser.add_argument("rows", nargs="*", metavar="ROW", help="; ".join(row.name for row in ROWS).replace("%", "%%"))
    parser.add_argument("--quick", action="store_true", help="two rows, one seed")
    parser.add_argument(
        "--data", type=Path, default=README.parents[1] / "shared" / "data", help="folder of the real data sets"
    )
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for results (default: %(default)s)")
    parser.add_argument("--readme", type=Path, default=README, help="where the table of all rows goes")
    given = parser.parse_args(arguments)
    unknown = set(given.rows) - {row.name for row in ROWS}
    if unknown:
        parser.error(f"no row is called '{sorted(unknown)[0]}'; --help lists them")
    options = Options(given.data, given.out / "quick" if given.quick else given.out, given.quick)
    measure(options, given.rows)
    if not given.rows and not given.quick:
        write_between_marks(given.readme, (options.out / "accuracy.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
