"""A web server on loopback that records all requests: programs under test must send none.

It is a process of its own, because GDAL may wait for an answer without letting other threads of Python run.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


@dataclass(frozen=True)
class Recorder:
    """The address of the server and the file of its requests."""

    url: str
    file: Path

    @property
    def requests(self) -> list[str]:
        """The requests so far: method and path."""
        return self.file.read_text().splitlines()


@contextlib.contextmanager
def recording(folder: Path) -> Iterator[Recorder]:
    """Run the server; it answers every request with 404."""
    file = folder / "requests.log"
    file.touch()
    with subprocess.Popen([sys.executable, __file__, file], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield Recorder(f"http://127.0.0.1:{int(server.stdout.readline())}", file)
        finally:
            server.terminate()


class _Handler(BaseHTTPRequestHandler):
    def answer(self) -> None:
        with Path(sys.argv[1]).open("a") as file:
            file.write(f"{self.command} {self.path}\n")
        self.send_error(404)

    do_GET = do_HEAD = do_POST = do_OPTIONS = answer

    def log_message(self, *_: object) -> None:
        pass


if __name__ == "__main__":
    listener = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    sys.stdout.write(f"{listener.server_port}\n")
    sys.stdout.flush()
    listener.serve_forever()
