"""Notifications: summaries sent to a command or a web address; failures return a reason."""

import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from flexroad.pipeline.run import alerts
from flexroad.pipeline.run.alerts import notify

SUMMARY = {"exit_code": 1, "failed": 3}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    for name, value in (("COMMAND_S", 1), ("ANSWER_S", 1), ("PAUSE_S", 0.01)):
        monkeypatch.setattr(alerts, name, value)


@pytest.fixture
def server():
    """A web server that answers with the queued status codes, then 200, and stores what it received."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self.server.received.append((self.path, self.headers["Content-Type"], json.loads(body)))
            self.send_response(self.server.answers.pop(0) if self.server.answers else 200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        server.received, server.answers = [], []
        server.url = f"http://127.0.0.1:{server.server_port}/hook/secret"
        serving = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        serving.start()
        yield server
        server.shutdown()
        serving.join()


def test_notify_command_gets_summary_on_stdin_and_in_file(tmp_path):
    assert notify(f"cat > {tmp_path}/a; cp $FLEXROAD_SUMMARY {tmp_path}/b", SUMMARY) is None
    assert [json.loads((tmp_path / name).read_text()) for name in "ab"] == [SUMMARY, SUMMARY]


def test_command_in_python_imports_modules_beside_it(tmp_path, monkeypatch):
    """Dask sets the variable of the workers in this process, too."""
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    (tmp_path / "beside.py").write_text("")
    (tmp_path / "notify.py").write_text("import beside")
    assert notify(f"{sys.executable} {tmp_path}/notify.py", SUMMARY) is None


def test_notify_command_fails_or_hangs_returns_reason(tmp_path):
    assert "ended with exit code 3" in notify("exit 3", SUMMARY)
    assert "ended with exit code 127" in notify("no-such-command", SUMMARY)
    # A background process of the shell must be killed, too.
    hanging = f"(sleep 60; touch {tmp_path}/late) & wait"
    assert "more than 1 s" in notify(hanging, SUMMARY)
    assert notify("exec 0<&-; exit 0", {"long": "x" * 1_000_000}) is None


def test_notify_url_gets_summary_as_json(server):
    assert notify(server.url, SUMMARY) is None
    assert server.received == [("/hook/secret", "application/json", SUMMARY)]


def test_notify_busy_server_retries(server):
    server.answers += [503, 429]
    assert notify(server.url, SUMMARY) is None
    assert len(server.received) == 3
    server.answers += [500] * 9
    assert notify(server.url, SUMMARY) == "127.0.0.1 answered 500"
    assert len(server.received) == 6


def test_notify_rejected_request_is_not_repeated_and_hides_address(server):
    server.answers += [404]
    assert notify(server.url, SUMMARY) == "127.0.0.1 answered 404"
    assert len(server.received) == 1


def test_notify_unreachable_server_returns_reason():
    reason = notify("http://127.0.0.1:9/hook/secret", SUMMARY)
    assert reason == "127.0.0.1 cannot be reached: ConnectionError"
    assert "cannot be reached" in notify("http://", SUMMARY)
    assert notify("http://[::1/secret", SUMMARY) == "the web address cannot be read"


def test_notify_address_in_upper_case_is_an_address(server):
    assert notify(server.url.replace("http:", "HTTP:"), SUMMARY) is None
    assert server.received == [("/hook/secret", "application/json", SUMMARY)]


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("false --header 'token: s3cret' https://hooks/s3cret", "`false ...`"),
        ("TOKEN=s3cret false", "`false ...`"),
        ("sleep 60; s3cret", "`sleep ...`"),
        ("exit 3 'open s3cret", "the command"),
        ("$(echo s3cret) x", "the command"),
        ("false s3cret\0", "`false ...`"),
        ("{ s3cret; }", "the command"),
    ],
)
def test_notify_failed_command_names_only_the_program(command, name):
    reason = notify(command, SUMMARY)
    assert reason.startswith(name)
    assert "s3cret" not in reason
