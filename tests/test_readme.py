"""What the README shows runs as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.cli.main import build_parser
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import save_tracks

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = re.findall(r"^connrsfm (.*?)(?:\s{2,}#.*)?$", README, flags=re.MULTILINE)


@pytest.mark.parametrize("code", PYTHON, ids=range(len(PYTHON)))
def test_python(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_tracks(tmp_path / "tracks.npz", isometric_bending(n_frames=5, n_points=40).tracks)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {"np": np})


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command: str) -> None:
    build_parser().parse_args(shlex.split(command))


def test_it_shows_both_commands_and_pictures_that_exist() -> None:
    assert len(re.findall(r"^python3 -m venv", README, flags=re.MULTILINE)) == 2
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", README)
    assert pictures
    assert all((Path(__file__).resolve().parents[1] / picture).is_file() for picture in pictures)
