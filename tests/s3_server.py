"""Object storage on loopback for tests: moto's S3 in a process of its own, which can be told to fail.

GDAL may hold the interpreter's lock while it waits for an answer, so that a thread would not do.
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
    """What goes wrong with which requests."""

    answer: str
    """One of `ANSWERS`, or how the connection ends: "cut" (reset), "shut" (no answer), "half" (amid one)."""
    method: str = ""
    """A regular expression, like the next."""
    path: str = ""
    skip: int = 0
    """How many such requests go well first."""
    first: int | None = None
    """How many then go wrong, of each path; None: all of them."""
    share: float = 1.0
    """How many of these do in the end, by chance."""
    seed: int = 0


class Due:
    """When a fault is due."""

    def __init__(self, fault: Fault):
        self.fault, self.random, self.met, self.failed = fault, random.Random(fault.seed), 0, Counter()

    def hits(self, method: str, path: str) -> bool:
        fault = self.fault
        if not (re.search(fault.method, method) and re.search(fault.path, path)):
            return False
        self.met += 1
        if self.met <= fault.skip or (fault.first is not None and self.failed[path] >= fault.first):
            return False
        if self.random.random() >= fault.share:
            return False
        self.failed[path] += 1
        return True


class Faulty:
    """Answers for the storage where a fault is due."""

    def __init__(self, app):
        self.app, self.faults, self.requests = app, [], []

    def __call__(self, environ, start_response):
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        if path == "/_faults":
            self.faults = [Due(Fault(**given)) for given in json.loads(_body(environ))]
            return _answer(start_response, "200 OK", b"")
        if path == "/_requests":
            found, self.requests = self.requests, []
            return _answer(start_response, "200 OK", json.dumps(found).encode())
        self.requests.append([method, path])
        fault = next((due.fault for due in self.faults if due.hits(method, path)), None)
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
            # Closing it will send a reset.
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
    """A server that runs."""

    url: str

    def fail(self, *faults: Fault) -> None:
        """Let these things go wrong from now on, and no others."""
        body = json.dumps([asdict(fault) for fault in faults]).encode()
        urllib.request.urlopen(urllib.request.Request(f"{self.url}/_faults", body, method="PUT")).close()

    def requests(self) -> list[tuple[str, str]]:
        """Return method and path of what was asked since the last call."""
        with urllib.request.urlopen(f"{self.url}/_requests") as answer:
            return [tuple(pair) for pair in json.load(answer)]


@contextmanager
def storage():
    """Run a server."""
    with subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        yield Storage(f"http://127.0.0.1:{int(process.stdout.readline())}")
        process.kill()


if __name__ == "__main__":
    server = make_server(
        "127.0.0.1", 0, Faulty(DomainDispatcherApplication(create_backend_app)), threaded=True
    )
    print(server.port, flush=True)  # noqa: T201
    # Ends with the tests, however they end.
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdin.read()
