"""A result on disk is that in memory."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from connrsfm_graph.reconstruct import reconstruct
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.running import crew
from connrsfm_graph.running.checkpoints import Checkpoints

from .conftest import FEW, assert_same, with_settings


def test_a_result_on_disk_is_that_in_memory(work, tmp_path, monkeypatch):
    in_memory, _ = reconstruct(work.tracks, FEW)
    monkeypatch.setattr(crew, "RESULT_BYTES", 1e12)
    kept = Checkpoints.beside(tmp_path / "out", work.tracks, FEW, resume=False)
    on_disk, _ = reconstruct(work.tracks, FEW, checkpoints=kept)
    assert isinstance(on_disk.points, np.memmap)
    for item in fields(in_memory):
        a, b = getattr(in_memory, item.name), getattr(on_disk, item.name)
        np.testing.assert_array_equal(a, b, err_msg=item.name) if isinstance(a, np.ndarray) else assert_same(a, b)
    for result, name in ((in_memory, "a.npz"), (on_disk, "b.npz")):
        result.save(tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    kept.remove()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]
    np.testing.assert_array_equal(on_disk.points, Reconstruction.load(tmp_path / "a.npz").points)


def test_more_memory_than_allowed_is_said(work, monkeypatch):
    monkeypatch.setattr("connrsfm_graph.reconstruct.peak_memory_mib", lambda: 600.0)
    _, record = reconstruct(work.tracks, with_settings(memory_limit="512MiB"))
    assert record.peak_memory_mib == 600.0
    assert "the run took 600 MiB, more than running.memory_limit (512MiB)" in record.warnings
