"""What a run has finished, on disk: after a kill at any moment, `--resume` goes on from there.

A folder beside the result holds one file for each finished stage and block, written beside and renamed, and the
fingerprint of the run: tracks, settings, versions and code. It disappears when the result is in place.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

import connrsfm_graph
import factors
from connrsfm_graph.config import as_dict
from connrsfm_graph.errors import InputError
from connrsfm_graph.files import check_output_folder, written_beside
from connrsfm_graph.run_record import package_versions
from connrsfm_graph.running.archive import Packed, packed, unpacked
from connrsfm_graph.tracks import Tracks

T = TypeVar("T")
_FINGERPRINT = "fingerprint"


@dataclass(frozen=True)
class Checkpoints:
    """Finished parts of one run by name; none is kept where there is no folder."""

    folder: Path | None = None

    @staticmethod
    def beside(out: Path, tracks: Tracks, config: object, resume: bool) -> Checkpoints:
        """The checkpoints of a run whose result goes to the folder `out`: those that an interrupted one has left where
        it is to be resumed, else none.

        Raises:
            InputError: the run to be resumed was another one, or the folder cannot be written.
        """
        folder = check_output_folder(out.absolute().with_name(f"{out.absolute().name}.partial"))
        wanted, known = fingerprint(tracks, config), folder / _FINGERPRINT
        if not (resume and known.exists()):
            if resume:
                print(f"--resume: there is no {folder} to go on from, so the run begins anew", file=sys.stderr)
            shutil.rmtree(folder, ignore_errors=True)
            with written_beside(known) as part:
                part.write_text(wanted, encoding="utf-8")
        elif known.read_text(encoding="utf-8") != wanted:
            raise InputError(
                f"{folder} holds the beginning of a run with other tracks, settings or versions; give --resume the "
                "same ones, or leave it out to start anew"
            )
        return Checkpoints(folder)

    def kept(self, name: str, cls: type[T], compute: Callable[[], T]) -> T:
        """The part of this name: as it was stored, or computed and stored. The value is the same in both cases."""
        found = self.find(name, cls)
        if found is not None:
            return found
        return unpacked(cls, self.keep(name, compute()))

    def keep(self, name: str, value: object) -> Packed:
        """Store a part."""
        pack = packed(value)
        if self.folder is not None:
            pack.save(self._path(name))
        return pack

    def find(self, name: str, cls: type[T]) -> T | None:
        """The part of this name, None where there is none or its file is damaged."""
        if self.folder is None or not self._path(name).exists():
            return None
        try:
            return unpacked(cls, Packed.load(self._path(name)))
        except InputError:  # the machine went down before it was on disk
            return None

    @contextmanager
    def told_on_error(self) -> Iterator[None]:
        """Where the block fails, say on standard error what can be resumed, or leave nothing if there is nothing."""
        try:
            yield
        except BaseException:
            if self.folder is not None and any(self.folder.glob("*.npz")):
                print(f"{self.folder} keeps what is finished; --resume goes on from there", file=sys.stderr)
            else:
                self.remove()
            raise

    def remove(self) -> None:
        """The run is over."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{name}.npz"


def fingerprint(tracks: Tracks, config: object) -> str:
    """What a result depends on, as one number: tracks, settings but for those of running, versions and code."""
    settings = as_dict(config)
    settings.pop("running", None)
    digest = hashlib.sha256(json.dumps([settings, package_versions(), tracks.camera.name], default=str).encode())
    for array in (tracks.pixels, tracks.visible, tracks.K):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).data)
    for package in (connrsfm_graph, factors):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()
