"""States in which a power failure may leave a folder, made from the recorded operations of a program.

Certainly there are the content of a file at its last fsync, and the names in a folder at its last fsync.
Of everything later, any part may be there: content may be lost or be zeros, new names may be missing and old
ones be back, in any order. A rename is there as a whole or not at all. File systems promise more than that.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from tests.faulty_files import Operation

FOLDER = 0
Names = dict[Path, int | None]
"""Names with the number of their file, `FOLDER`, or None for a removed name."""
State = dict[Path, tuple[bytes | None, int | None]]
"""Content (None for a folder) and time (ns, None if unknown) of each name."""


@dataclass
class Recording:
    """The files below a folder, then what was written there; an observer for `tests.faulty_files`."""

    root: Path
    operations: list[Operation] = field(default_factory=list)
    before: dict[Path, bytes | None] = field(default_factory=dict)
    """Contents of the files, None for folders."""
    times: dict[int | Path, int] = field(default_factory=dict)
    """Times of the files before, and of renamed files by the number of the operation (ns)."""

    def __post_init__(self) -> None:
        for path in sorted(self.root.rglob("*")):
            self.before[path] = None if path.is_dir() else path.read_bytes()
            self.times[path] = path.stat().st_mtime_ns

    def __call__(self, operation: Operation) -> None:
        if operation.kind == "rename":
            self.times[len(self.operations)] = operation.path.stat().st_mtime_ns
        self.operations.append(operation)


@dataclass
class _File:
    on_disk: bytes = b""
    pending: list[Operation] = field(default_factory=list)
    time: int | None = None


class Disk:
    """What is certainly on the disk after the first operations of a recording, and what only may be there."""

    def __init__(self, recording: Recording, end: int) -> None:
        self._files: list[_File] = [_File()]
        self._names: Names = {recording.root: FOLDER}
        for path, content in recording.before.items():
            self._names[path] = FOLDER if content is None else self._new(content, recording.times[path])
        self._on_disk: Names = dict(self._names)
        self._pending: list[Names] = []
        for number, operation in enumerate(recording.operations[:end]):
            self._apply(operation, recording.times.get(number))
        self._root = recording.root

    def _new(self, content: bytes = b"", time: int | None = None) -> int:
        self._files.append(_File(content, time=time))
        return len(self._files) - 1

    def _apply(self, operation: Operation, time: int | None) -> None:
        path, target = operation.path, operation.target
        if operation.kind in ("create", "mkdir"):
            self._rename({path: self._new() if operation.kind == "create" else FOLDER})
        elif operation.kind in ("remove", "rmdir"):
            self._rename({path: None})
        elif operation.kind in ("rename", "link"):
            number = self._names[path]
            self._files[number].time = time
            self._rename({target: number} | ({path: None} if operation.kind == "rename" else {}))
        elif operation.kind == "fsync":
            self._fsync(path)
        else:
            self._files[self._names[path]].pending.append(operation)

    def _rename(self, names: Names) -> None:
        self._names |= names
        self._pending.append(names)

    def _fsync(self, path: Path) -> None:
        number = self._names[path]
        if number != FOLDER:
            file = self._files[number]
            file.on_disk, file.pending = _changed(file.on_disk, file.pending), []
            return
        for names in self._pending:
            if any(name.parent == path for name in names):
                self._on_disk |= names
        self._pending = [names for names in self._pending if all(name.parent != path for name in names)]

    def after_failure(self, random: Random, least: bool = False) -> State:
        """Return one possible state; with ``least`` the one that has only what is certain."""
        names = dict(self._on_disk)
        for change in [] if least else _some(self._pending, random):
            names |= change
        state: State = {}
        for path, number in names.items():
            if number is None or path == self._root:
                continue
            folders = path.relative_to(self._root).parents[:-1]
            if all(names.get(self._root / folder) == FOLDER for folder in folders):
                file = self._files[number]
                state[path] = (None if number == FOLDER else _content(file, random, least), file.time)
        return state


def _some(changes: Sequence, random: Random) -> Sequence:
    """Return all, none, the first or any of the changes, in their order."""
    kept = random.choice(("all", "none", "first", "any"))
    if kept == "first":
        return changes[: random.randint(0, len(changes))]
    share = {"all": 1.0, "none": 0.0, "any": random.random()}[kept]
    return [change for change in changes if random.random() < share]


def _content(file: _File, random: Random, least: bool) -> bytes:
    if least or not file.pending:
        return file.on_disk
    if random.random() < 0.3:
        # The size is on the disk, the data are not.
        size = len(_changed(file.on_disk, file.pending))
        return file.on_disk[:size].ljust(size, b"\0")
    return _changed(file.on_disk, _some(file.pending, random))


def _changed(content: bytes, operations: Sequence[Operation]) -> bytes:
    data = bytearray(content)
    for operation in operations:
        start = operation.offset
        data.extend(bytes(max(start - len(data), 0)))
        if operation.kind == "truncate":
            del data[start:]
        else:
            data[start : start + len(operation.data)] = operation.data
    return bytes(data)


def states(recording: Recording, count: int, end: int | None = None) -> Iterator[State]:
    """Yield possible states after random operations, or after the first ``end`` of them."""
    for seed in range(count):
        random = Random(seed)
        last = random.randint(0, len(recording.operations)) if end is None else end
        yield Disk(recording, last).after_failure(random)


def write_state(state: State, root: Path, folder: Path) -> None:
    """Write a state of the files below ``root`` to another folder."""
    for path in sorted(state):
        content, time = state[path]
        target = folder / path.relative_to(root)
        if content is None:
            target.mkdir(parents=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        if time is not None:
            os.utime(target, ns=(time, time))
