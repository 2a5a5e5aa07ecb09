"""Proof that a worker has the same files as the client: its run, its store and the sources of a tile."""

from __future__ import annotations

import contextlib
import secrets
from dataclasses import dataclass, field
from pathlib import PurePath
from types import TracebackType

from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import PROBE, FileStat, parse_location
from flexroad.pipeline.worker.tile import TileJob

MOUNT = "mount it there under the same path"
"""Remedy for a worker with other files."""


Proof = tuple[str, dict[str, FileStat | None]]
"""Name of the file that a worker has written into each folder, and the source files that differ from the
tile's graph, with their size and version on the worker."""


@dataclass(frozen=True)
class SharedFiles:
    """The folders that client and workers share (a `flexroad.pipeline.execute.executor.Probe`).

    The client writes a file with a random name into each folder. A worker looks for it and writes another
    file, which the client looks for. At the end the client removes all of these files. ``flexroad clean``
    removes the files of a killed client.
    """

    folders: tuple[str, ...]
    """The run and its store."""
    start: str = field(default_factory=lambda: f"{PROBE}{secrets.token_hex(8)}")
    """Start of the names of all files; 16 hexadecimal digits follow."""

    @property
    def name(self) -> str:
        """Name of the client's files."""
        return f"{self.start}{0:016x}"

    def __enter__(self) -> SharedFiles:
        """Write the client's files."""
        for folder in self.folders:
            paths.write(parse_location(folder) / self.name, b"")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for folder in map(parse_location, self.folders):
            with contextlib.suppress(OSError):
                for name in paths.hidden_files(folder):
                    if name.startswith(self.start):
                        paths.remove(folder / name)

    def answer(self, job: TileJob) -> Proof:
        """Return the proof of this process, a worker, whose first job is ``job``."""
        own = f"{self.start}{secrets.token_hex(8)}"
        try:
            for folder in self.folders:
                self._meet(folder, own)
            return own, _different(job)
        except OSError:
            self._remove(own)
            raise

    def accept(self, proof: Proof) -> None:
        """Check, in the client, that the files of a worker have arrived, and that it has the same sources."""
        name, different = proof
        missing = [folder for folder in self.folders if not _arrived(folder, name)]
        self._remove(name)
        if missing:
            raise OSError(f"what it writes to {missing[0]} does not arrive here; {MOUNT}")
        for file, there in different.items():
            # If a file has changed since the graph was made, it differs here, too.
            if source_stat(parse_location(file)) != there:
                what = "does not exist" if there is None else "has another size or time"
                raise OSError(f"{file} {what} there; {MOUNT}")

    def _meet(self, folder: str, own: str) -> None:
        try:
            paths.read(parse_location(folder) / self.name)
            paths.write(parse_location(folder) / own, b"")
        except FileNotFoundError as error:
            raise OSError(f"{folder} is not the same folder there as here; {MOUNT}") from error
        except OSError as error:
            raise OSError(
                f"{folder}: {error.strerror or error}; make it readable and writable for the worker"
            ) from error

    def _remove(self, name: str) -> None:
        for folder in self.folders:
            with contextlib.suppress(OSError):
                paths.remove(parse_location(folder) / name)


def _arrived(folder: str, name: str) -> bool:
    location = parse_location(folder)
    if paths.stat(location / name) is None:
        paths.refresh(location)
    return paths.stat(location / name) is not None


def _different(job: TileJob) -> dict[str, FileStat | None]:
    """Return size and version of source files that differ in this process; at most one file per folder."""
    known = {file: stat for file, stat in job.graph.file_stats.items() if stat is not None}
    one_of_each = {str(PurePath(file).parent): file for file in known}.values()
    here = {file: source_stat(parse_location(file)) for file in one_of_each}
    return {file: stat for file, stat in here.items() if stat != known[file]}
