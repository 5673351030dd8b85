"""The whole job through the command line, with the real pipeline."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from connrsfm_graph.cli.main import main


@pytest.mark.realdata
@pytest.mark.slow
def test_paper_mode_on_the_tshirt(
    realdata: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At or below the figures the paper reports for its own method on this sequence, and the same twice."""
    tracks = realdata("tshirt.npz")
    for name in ("a", "b"):
        arguments = ["reconstruct", str(tracks), "--mode", "paper", "--out", str(tmp_path / name), "--no-report"]
        assert main(arguments) == 0
    assert (tmp_path / "a" / "result.npz").read_bytes() == (tmp_path / "b" / "result.npz").read_bytes()
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "a"), "--truth", str(tracks), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["coverage"] == 1.0
    assert figures["e3d_percent"] <= 2.24
    assert figures["shape_error_deg"] <= 17.5
    seconds = json.loads((tmp_path / "a" / "run.json").read_text())["seconds"]
    assert {"image graph", "warps", "pre-step", "solve"} <= set(seconds)
