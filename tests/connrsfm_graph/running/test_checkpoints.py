"""What is finished is found again, and only by the run that left it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.running.checkpoints import Checkpoints, fingerprint

from .conftest import FEW, with_settings


@dataclass(frozen=True)
class Part:
    array: np.ndarray
    number: float


def part(number: float = 0.1) -> Part:
    return Part(np.arange(3.0), number)


def never() -> Part:
    raise AssertionError("computed again")


def test_a_part_is_computed_once(work, tmp_path):
    first = Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    kept = first.kept("part", Part, part)
    again = Checkpoints.beside(tmp_path / "out", work.tracks, with_settings(workers=2, block=3), resume=True)
    found = again.kept("part", Part, never)
    assert (found.number, found.array.tolist()) == (kept.number, kept.array.tolist())
    assert Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False).find("part", Part) is None


def test_nothing_is_kept_without_a_folder():
    assert Checkpoints().kept("part", Part, part).number == 0.1
    assert Checkpoints().find("part", Part) is None


def test_a_damaged_part_is_computed_again(work, tmp_path):
    kept = Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    kept.kept("part", Part, part)
    (path,) = tmp_path.glob("out.partial/*.npz")
    path.write_bytes(path.read_bytes()[:-40])
    assert kept.kept("part", Part, lambda: part(0.2)).number == 0.2
    assert kept.kept("part", Part, never).number == 0.2


def test_another_run_is_refused(work, tmp_path):
    Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    moved = replace(work.tracks, pixels=np.where(work.tracks.visible[..., None], work.tracks.pixels + 1e-9, np.nan))
    for tracks, config in ((work.tracks, replace(FEW, seed=1)), (moved, FEW)):
        with pytest.raises(InputError, match="other tracks, settings or versions"):
            Checkpoints.beside(tmp_path / "out", tracks, config, resume=True)


def test_how_a_run_is_carried_out_is_not_part_of_it(work):
    assert fingerprint(work.tracks, FEW) == fingerprint(work.tracks, with_settings(workers=7, memory_limit="9GiB"))


def test_an_error_tells_what_can_be_resumed(work, tmp_path, capsys):
    kept = Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    with pytest.raises(KeyboardInterrupt), kept.told_on_error():
        raise KeyboardInterrupt
    assert not kept.folder.exists()
    kept = Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    kept.kept("part", Part, part)
    with pytest.raises(KeyboardInterrupt), kept.told_on_error():
        raise KeyboardInterrupt
    assert "out.partial keeps what is finished; --resume goes on" in capsys.readouterr().err
    assert kept.folder.exists()


def test_nothing_to_resume_is_said(work, tmp_path, capsys):
    Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=True)
    assert not capsys.readouterr().err
    Checkpoints.beside(tmp_path / "other", work.tracks, FEW, resume=True)
    assert "there is no" in (said := capsys.readouterr().err)
    assert "other.partial to go on from" in said
