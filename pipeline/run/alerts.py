"""Notify the operator of a failed run: by a shell command or a POST to a web address."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.scratch import ScratchFolder

requests = lazy("requests")
urllib3 = lazy("urllib3")

BUSY = (429, 500, 502, 503, 504)
"""HTTP status codes after which the request is repeated."""
COMMAND_S = 120.0
"""Time limit of a command (s)."""
ANSWER_S = 10.0
"""Time limit of an answer of a web server (s)."""
RETRIES = 2
PAUSE_S = 1.0
"""Pause before the first retry (s); doubled before each further one."""


def notify(target: str, summary: Mapping[str, Any]) -> str | None:
    """Send a summary to the target.

    Parameters
    ----------
    target : str
        A web address (``http://...`` or ``https://...``), which receives the summary as JSON by POST;
        anything else is a shell command, which gets the JSON on its standard input and in the file named by
        the variable FLEXROAD_SUMMARY. The file is removed when the command ends.
    summary : mapping
        The content, serialisable as JSON.

    Returns
    -------
    str or None
        The reason of a failure; None on success. Nothing is raised: a run does not depend on its alert.
    """
    text = json.dumps(summary, indent=1)
    if re.match(r"https?://", target, re.IGNORECASE):
        return _post(target, text)
    return _run_command(target, text)


def _post(url: str, text: str) -> str | None:
    try:
        # The rest of the address is often a secret: messages name only the host.
        scheme, host = urlsplit(url).scheme, urlsplit(url).hostname
    except ValueError:
        return "the web address cannot be read"
    retry = urllib3.Retry(
        RETRIES,
        backoff_factor=PAUSE_S / 2,
        status_forcelist=BUSY,
        allowed_methods=None,
        # The header may request a pause of an hour.
        respect_retry_after_header=False,
        raise_on_status=False,
    )
    with requests.Session() as session:
        session.mount(f"{scheme}://", requests.adapters.HTTPAdapter(max_retries=retry))
        try:
            answer = session.post(
                url,
                text.encode(),
                headers={"Content-Type": "application/json"},
                timeout=ANSWER_S,
                allow_redirects=False,
            )
        except (requests.RequestException, ValueError) as error:
            return f"{host} cannot be reached: {type(error).__name__}"
    return None if answer.status_code // 100 == 2 else f"{host} answered {answer.status_code}"


def _run_command(command: str, text: str) -> str | None:
    try:
        with ScratchFolder() as folder:
            path = Path(folder) / "summary.json"
            path.write_text(text)
            # The user's program may import modules beside it; the variable is for workers.
            variables = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
            # Its output goes to standard error, with the messages of the run.
            process = subprocess.Popen(
                command,
                shell=True,
                stdin=subprocess.PIPE,
                stdout=2,
                env={**variables, "FLEXROAD_SUMMARY": str(path)},
                start_new_session=True,
            )
            return _wait(process, text, _program(command))
    except (OSError, ValueError) as error:
        # The message of an error may have the complete command.
        reason = (isinstance(error, OSError) and error.strerror) or type(error).__name__
        return f"{_program(command)} cannot be run: {reason}"


def _program(command: str) -> str:
    """Return what a shell command calls first, for messages: its arguments are often secrets."""
    try:
        words = shlex.split(command)
    except ValueError:
        words = []
    program = next((word for word in words if not re.match(r"\w+=", word)), "")
    return f"`{program} ...`" if re.fullmatch(r"[\w./+-]{1,100}", program) else "the command"


def _wait(process: subprocess.Popen[bytes], text: str, name: str) -> str | None:
    try:
        process.communicate(text.encode(), COMMAND_S)
    except subprocess.TimeoutExpired:
        # The complete process group: the command may have started others.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return f"{name} took more than {COMMAND_S:g} s and was killed"
    return f"{name} ended with exit code {process.returncode}" if process.returncode else None
