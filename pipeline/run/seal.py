"""Seals of permissions of a run: they show that this user gave the permissions on this machine.

``RUN/run.json`` has the folders that the user allowed when the run was made, and the shared store;
``RUN/config.yaml`` has the options of workers that can start programs. A run folder may come from anyone,
with any content. So these values are sealed with a secret key of the user, and ignored without the seal.
The key is made on first use and lies in ``$XDG_STATE_HOME/flexroad/key``, by default
``~/.local/state/flexroad/key``.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.paths import flush_names

KEY_BYTES = 32


def seal(values: Sequence[str] | Mapping[str, Any]) -> str:
    """Return the seal of a list of folders or of named values; empty if no key can be read or written."""
    key = _key() or _new_key()
    return _digest(key, values) if key else ""


def sealed(values: object, text: object) -> bool:
    """Return whether a text is the seal of a list of folders or of named values."""
    key = _key()
    if not key or not isinstance(values, list | dict) or not isinstance(text, str):
        return False
    return hmac.compare_digest(_digest(key, values).encode(), text.encode())


def _digest(key: bytes, values: Sequence[str] | Mapping[str, Any]) -> str:
    content = dict(values) if isinstance(values, Mapping) else list(values)
    return hmac.new(key, json.dumps(content, sort_keys=True).encode(), hashlib.sha256).hexdigest()


def _path() -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path(os.environ.get("HOME") or "/", ".local", "state")
    return Path(state, "flexroad", "key")


def _key() -> bytes:
    """Return the user's key, empty if it does not exist."""
    try:
        key = _path().read_bytes()
    except OSError:
        return b""
    return key if len(key) == KEY_BYTES else b""


def _new_key() -> bytes:
    """Write a new key unless another process has just written one; return the key, empty if that fails."""
    path = _path()
    temporary = path.with_name(f".key.{secrets.token_hex(8)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(KEY_BYTES))
            file.flush()
            # A power failure must not leave a key of zeros, which other users could guess.
            os.fsync(file.fileno())
        # Unlike a rename, a link does not replace a key that another process has just written.
        with contextlib.suppress(FileExistsError):
            os.link(temporary, path)
        flush_names(path.parent, path.parent.parent)
    except OSError:
        return b""
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return _key()
