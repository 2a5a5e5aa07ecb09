"""Object storage on loopback for tests: moto's S3 server in a separate process, with configurable faults.

A thread is not possible: GDAL may hold the interpreter's lock while it waits for an answer.
"""

import json
import random
import re
import socket
import struct
import subprocess
import sys
import threading
import urllib.request
from collections import Counter
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server

SLOW_DOWN = b"<?xml version='1.0'?><Error><Code>SlowDown</Code><Message>Please slow down.</Message></Error>"
ANSWERS = {
    "slow": ("503 Slow Down", SLOW_DOWN),
    "error": ("500 Internal Server Error", SLOW_DOWN.replace(b"SlowDown", b"InternalError")),
    "denied": ("403 Forbidden", SLOW_DOWN.replace(b"SlowDown", b"AccessDenied")),
}


@dataclass
class Fault:
    """A fault and the requests that it affects."""

    answer: str
    """One of `ANSWERS`, or how the connection ends: "cut" (reset), "shut" (no answer), "half" (cut off)."""
    method: str = ""
    """Regular expression for the method."""
    path: str = ""
    """Regular expression for the path."""
    skip: int = 0
    """Number of matching requests that succeed first."""
    first: int | None = None
    """Number of requests per path that fail then; None for all."""
    share: float = 1.0
    """Probability that such a request fails."""
    seed: int = 0


class FaultState:
    """A fault and the counts of its requests."""

    def __init__(self, fault: Fault):
        self.fault, self.random, self.matched, self.failed = fault, random.Random(fault.seed), 0, Counter()

    def applies(self, method: str, path: str) -> bool:
        """Count a request; return whether it fails."""
        fault = self.fault
        if not (re.search(fault.method, method) and re.search(fault.path, path)):
            return False
        self.matched += 1
        if self.matched <= fault.skip or (fault.first is not None and self.failed[path] >= fault.first):
            return False
        if self.random.random() >= fault.share:
            return False
        self.failed[path] += 1
        return True


class FaultyApp:
    """WSGI application that answers with a fault if one applies, else passes the request on."""

    def __init__(self, app):
        self.app, self.faults, self.requests = app, [], []

    def __call__(self, environ, start_response):
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        if path == "/_faults":
            self.faults = [FaultState(Fault(**fields)) for fields in json.loads(_body(environ))]
            return _answer(start_response, "200 OK", b"")
        if path == "/_requests":
            requests, self.requests = self.requests, []
            return _answer(start_response, "200 OK", json.dumps(requests).encode())
        self.requests.append([method, path])
        fault = next((state.fault for state in self.faults if state.applies(method, path)), None)
        if fault is None:
            return self.app(environ, start_response)
        if fault.answer in ANSWERS:
            _body(environ)
            status, text = ANSWERS[fault.answer]
            return _answer(start_response, status, b"" if method == "HEAD" else text)
        if fault.answer == "half":
            return _half(self.app(environ, start_response), environ)
        connection = environ["werkzeug.socket"]
        if fault.answer == "cut":
            # With this option closing sends a reset.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection._real_close()
        else:
            connection.shutdown(socket.SHUT_RDWR)
        return []


def _half(answer, environ):
    whole = b"".join(answer)
    yield whole[: len(whole) // 2]
    environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)


def _body(environ):
    return environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))


def _answer(start_response, status, text):
    start_response(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(text)))])
    return [text]


@dataclass(frozen=True)
class Storage:
    """A running server."""

    url: str

    def fail(self, *faults: Fault) -> None:
        """Replace the current faults by these."""
        body = json.dumps([asdict(fault) for fault in faults]).encode()
        urllib.request.urlopen(urllib.request.Request(f"{self.url}/_faults", body, method="PUT")).close()

    def requests(self) -> list[tuple[str, str]]:
        """Return method and path of the requests since the last call."""
        with urllib.request.urlopen(f"{self.url}/_requests") as answer:
            return [tuple(pair) for pair in json.load(answer)]


@contextmanager
def storage():
    """Run a server in a separate process."""
    with subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        yield Storage(f"http://127.0.0.1:{int(process.stdout.readline())}")
        process.kill()


if __name__ == "__main__":
    server = make_server(
        "127.0.0.1", 0, FaultyApp(DomainDispatcherApplication(create_backend_app)), threaded=True
    )
    print(server.port, flush=True)  # noqa: T201
    # Standard input closes when the tests end, even if they are killed.
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdin.read()
