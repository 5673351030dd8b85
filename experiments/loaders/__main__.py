"""List the data sets, or convert one to a track file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from connrsfm_graph.tracks import save_tracks
from experiments.loaders import datasets


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    known = datasets()
    parser = argparse.ArgumentParser(prog="python -m experiments.loaders", description=__doc__)
    parser.add_argument("name", nargs="?", choices=known, help="data set; without it all are listed")
    parser.add_argument("folder", nargs="?", type=Path, help="where its files are")
    parser.add_argument("out", nargs="?", type=Path, help="track file to write, .npz")
    given = parser.parse_args(arguments)
    if given.name is None:
        for name, dataset in known.items():
            print(f"{name}: {dataset.title}\n  from {dataset.source}\n  expects {dataset.expects}")
        return 0
    if given.out is None:
        parser.error("NAME needs FOLDER and OUT.npz")
    tracks = known[given.name].load(given.folder)
    save_tracks(given.out, tracks)
    print(f"{given.out}: {tracks.n_points} points in {tracks.n_frames} images")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
