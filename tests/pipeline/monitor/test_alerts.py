"""The alarm: a command or a web address hears of it, and one that does not hear harms nothing."""

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from flexroad.pipeline.monitor.alerts import RetryPolicy, notify

TOLD = {"exit_code": 1, "failed": 3}
QUICK = RetryPolicy(command_s=1, answer_s=1, pause_s=0.01)


@pytest.fixture
def server():
    """A web server that answers with what is queued, then 200, and keeps what it got."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            got = self.rfile.read(int(self.headers["Content-Length"]))
            self.server.got.append((self.path, self.headers["Content-Type"], json.loads(got)))
            self.send_response(self.server.answers.pop(0) if self.server.answers else 200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as made:
        made.got, made.answers = [], []
        made.url = f"http://127.0.0.1:{made.server_port}/hook/secret"
        serving = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        serving.start()
        yield made
        made.shutdown()
        serving.join()


def test_a_command_gets_it_on_its_input_and_in_a_file(tmp_path):
    assert notify(f"cat > {tmp_path}/a; cp $FLEXROAD_SUMMARY {tmp_path}/b", TOLD) is None
    assert [json.loads((tmp_path / name).read_text()) for name in "ab"] == [TOLD, TOLD]


def test_a_command_that_fails_or_hangs_is_said(tmp_path):
    assert "ended with exit code 3" in notify("exit 3", TOLD)
    assert "ended with exit code 127" in notify("no-such-command", TOLD)
    # What the shell started would outlive it, and hold the run up.
    hanging = f"(sleep 60; touch {tmp_path}/late) & wait"
    assert "more than 1 s" in notify(hanging, TOLD, QUICK)
    assert notify("exec 0<&-; exit 0", {"long": "x" * 1_000_000}) is None


def test_an_address_gets_it_as_json(server):
    assert notify(server.url, TOLD) is None
    assert server.got == [("/hook/secret", "application/json", TOLD)]


def test_a_busy_server_is_asked_again_a_few_times(server):
    server.answers += [503, 429]
    assert notify(server.url, TOLD, QUICK) is None
    assert len(server.got) == 3
    server.answers += [500] * 9
    assert notify(server.url, TOLD, QUICK) == "127.0.0.1 answered 500"
    assert len(server.got) == 6


def test_what_is_refused_is_not_repeated_and_the_address_stays_secret(server):
    server.answers += [404]
    assert notify(server.url, TOLD, QUICK) == "127.0.0.1 answered 404"
    assert len(server.got) == 1


def test_a_server_that_is_not_there_is_said():
    why = notify("http://127.0.0.1:9/hook/secret", TOLD, QUICK)
    assert why == "127.0.0.1 cannot be told: ConnectionError"
    assert "cannot be told" in notify("http://", TOLD, QUICK)
