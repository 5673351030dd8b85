"""Kills at random moments lose nothing: the run that was resumed ends with the bytes of an uninterrupted one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import save_tracks

KILLS = 10


def command(tracks: Path, out: Path, *arguments: str) -> list[str]:
    settings = [f"--set={key}" for key in ("keyframes.most=8", "running.block=2")]
    program = [sys.executable, "-m", "connrsfm_graph", "reconstruct"]
    return [*program, str(tracks), "--out", str(out), "--no-report", *settings, *arguments]


def children(pid: int) -> list[int]:
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(line) for line in listed.stdout.split()]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_kills_lose_nothing(work, tmp_path, workers):
    tracks, out, left = tmp_path / "tracks.npz", tmp_path / "out", tmp_path / "out.partial"
    save_tracks(tracks, work.tracks)
    subprocess.run(command(tracks, tmp_path / "whole"), check=True, capture_output=True)
    wanted = (tmp_path / "whole" / "result.npz").read_bytes()
    rng, kills = np.random.default_rng(workers), 0
    resume = command(tracks, out, "--resume", "--workers", str(workers))
    while kills < KILLS // 2:
        # So many files more, and then some: anywhere between the start and the end, however fast the machine.
        files = len(list(left.glob("*"))) + rng.integers(0, 4)
        with (tmp_path / "log").open("w") as log:
            running = subprocess.Popen(resume, stdout=log, stderr=log)
        while running.poll() is None and len(list(left.glob("*"))) < files:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.3))
        if running.poll() is not None:
            assert running.returncode == 0, (tmp_path / "log").read_text()
            assert (out / "result.npz").read_bytes() == wanted
            (out / "result.npz").unlink()
            continue
        at_work = children(running.pid)
        running.send_signal(signal.SIGKILL)
        running.wait()
        kills += 1
        if at_work:
            with suppress(ProcessLookupError):  # it may have noticed
                os.kill(at_work[0], signal.SIGKILL)
    subprocess.run(resume, check=True, capture_output=True)
    assert (out / "result.npz").read_bytes() == wanted
    assert not left.exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux which processes there are")
def test_workers_end_with_the_run_that_is_killed(work, tmp_path):
    save_tracks(tmp_path / "tracks.npz", work.tracks)
    running = subprocess.Popen(command(tmp_path / "tracks.npz", tmp_path / "out", "--workers", "2"))
    while not (at_work := children(running.pid)):
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.wait()
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in at_work):
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.slow
def test_a_long_sequence_fits_its_memory(work, tmp_path):
    tracks = work.tracks.select(frames=np.arange(400) % work.tracks.n_frames)
    save_tracks(tmp_path / "tracks.npz", tracks)
    arguments = command(tmp_path / "tracks.npz", tmp_path / "out", "--memory-limit", "512MiB")
    subprocess.run(arguments, check=True, capture_output=True)
    assert 50 < RunRecord.load(tmp_path / "out").peak_memory_mib < 512
