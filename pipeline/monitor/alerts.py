"""Tell somebody that a run went wrong: by a command of the operator's, or by a POST to a web address."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

BUSY = (429, 500, 502, 503, 504)
"""Answers of a web server that is worth asking again."""


@dataclass(frozen=True)
class RetryPolicy:
    """How long an alarm may take."""

    command_s: float = 120
    answer_s: float = 10
    retries: int = 2
    pause_s: float = 1
    """Before the second try; twice as long before each following one."""


def notify(target: str, told: Mapping[str, Any], patience: RetryPolicy | None = None) -> str | None:
    """Tell the target; return why that did not succeed, or None: an alarm that fails is no fault of the run.

    Parameters
    ----------
    target : str
        ``http://...`` or ``https://...``, which gets what is told as JSON; anything else is a command for
        the shell, which gets the same on its standard input and in the file FLEXROAD_SUMMARY names. The file
        lasts as long as the command.
    """
    text = json.dumps(told, indent=1)
    patience = patience or RetryPolicy()
    if target.startswith(("http://", "https://")):
        return _post(target, text, patience)
    return _call(target, text, patience)


def _post(url: str, text: str, patience: RetryPolicy) -> str | None:
    import requests
    from requests.adapters import HTTPAdapter
    from urllib3 import Retry

    # The rest of such an address is often a secret: it goes into no log.
    place = urlsplit(url).hostname
    again = Retry(
        patience.retries,
        backoff_factor=patience.pause_s / 2,
        status_forcelist=BUSY,
        allowed_methods=None,
        # It may ask for an hour.
        respect_retry_after_header=False,
        raise_on_status=False,
    )
    with requests.Session() as session:
        session.mount(f"{urlsplit(url).scheme}://", HTTPAdapter(max_retries=again))
        try:
            answer = session.post(
                url,
                text.encode(),
                headers={"Content-Type": "application/json"},
                timeout=patience.answer_s,
                allow_redirects=False,
            )
        except requests.RequestException as error:
            return f"{place} cannot be told: {type(error).__name__}"
    return None if answer.status_code // 100 == 2 else f"{place} answered {answer.status_code}"


def _call(command: str, text: str, patience: RetryPolicy) -> str | None:
    try:
        with tempfile.TemporaryDirectory(prefix="flexroad-") as folder:
            path = Path(folder) / "summary.json"
            path.write_text(text)
            # What it says goes with what the run says of itself, not among its results.
            process = subprocess.Popen(
                command,
                shell=True,
                stdin=subprocess.PIPE,
                stdout=2,
                env={**os.environ, "FLEXROAD_SUMMARY": str(path)},
                start_new_session=True,
            )
            return _wait(process, text, patience)
    except (OSError, ValueError) as error:
        return f"`{command}` cannot be run: {error}"


def _wait(process: subprocess.Popen[bytes], text: str, patience: RetryPolicy) -> str | None:
    try:
        process.communicate(text.encode(), patience.command_s)
    except subprocess.TimeoutExpired:
        # With all that it started.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return f"`{process.args!s}` took more than {patience.command_s:g} s and was ended"
    return f"`{process.args!s}` ended with exit code {process.returncode}" if process.returncode else None
