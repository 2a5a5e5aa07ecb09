"""Serve a folder to browsers of this computer alone."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.links import contained

LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")


class _Files(SimpleHTTPRequestHandler):
    """Files of a folder, for requests to this computer by its own name."""

    def send_head(self) -> Any:
        # Else a page of the web could read the folder, by a name of its own that leads here.
        host = self.headers.get("Host", "").rpartition(":")[0]
        if host not in NAMES:
            self.send_error(403)
            return None
        try:
            contained(Path(self.translate_path(self.path)), Path(self.directory))
        except (OSError, ValueError):
            # A link that leads out of the folder, or no name of a file, such as /%00.
            self.send_error(404)
            return None
        return super().send_head()

    def list_directory(self, path: Any) -> Any:
        self.send_error(404)

    def end_headers(self) -> None:
        # The folder may be written again while it is served.
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


def server(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server of a folder on this computer's loopback address.

    Parameters
    ----------
    port : int
        0 for any free one.

    Raises
    ------
    OSError
        If the port is in use.
    """
    return ThreadingHTTPServer((LOOPBACK, port), partial(_Files, directory=str(folder)))
