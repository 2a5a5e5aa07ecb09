"""Files and a server that nothing may read, to see what leads outside."""

import contextlib
import ctypes
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.make_rasters import write
from tests.recording_server import Recorder, recording

IN_OPEN = 0x20


@dataclass
class Outside:
    """A folder outside of what may be read, and a web server on loopback."""

    folder: Path
    server: Recorder
    _inotify: int
    _requests: int = field(default=0, init=False)

    @property
    def names(self) -> list[str]:
        """Names and addresses to put into damaged files."""
        files = [str(path) for path in sorted(self.folder.iterdir())]
        relative = f"../outside/{Path(files[0]).name}"
        addresses = [f"{self.server.url}/a.tif", f"/vsicurl/{self.server.url}/b.tif"]
        return [*files, *(f"file://{name}" for name in files), relative, *addresses]

    def touched(self) -> str:
        """Return what was opened or asked since the last call, empty if nothing."""
        try:
            events = os.read(self._inotify, 65536)
        except BlockingIOError:
            events = b""
        requests = self.server.requests
        new, self._requests = requests[self._requests :], len(requests)
        opened = [path.name for path in self.folder.iterdir() if path.name.encode() in events]
        if not opened and not new:
            return ""
        return f"read outside: {', '.join([*opened, *new])}"


@contextlib.contextmanager
def outside(folder: Path) -> Iterator[Outside]:
    """Make the folder, and start the server."""
    folder.mkdir()
    write(folder / "secret.tif", [[1.0, 2.0], [3.0, 4.0]])
    # No YAML: a configuration may extend one in any folder.
    for name in ("secret.json", "secret.png", "secret.txt"):
        (folder / name).write_text("{}")
    libc = ctypes.CDLL(None, use_errno=True)
    inotify = libc.inotify_init1(os.O_NONBLOCK)
    assert inotify >= 0
    assert libc.inotify_add_watch(inotify, os.fsencode(folder), IN_OPEN) >= 0
    web = folder.parent / "web"
    web.mkdir()
    try:
        with recording(web) as server:
            yield Outside(folder, server, inotify)
    finally:
        os.close(inotify)
