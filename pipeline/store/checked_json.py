"""JSON files with a checksum: the markers of tiles, and what a run records about itself.

A flipped bit in a figure leaves valid JSON. So each file has the checksum of its own content, and one that
does not agree counts as damaged; what it held is computed or written again.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

KEY = "flexroad:checksum"


def dumps(content: dict[str, Any]) -> bytes:
    """Return an object as JSON, with its checksum."""
    return json.dumps({**content, KEY: _checksum(content)}, indent=1, allow_nan=False).encode()


def loads(data: bytes) -> dict[str, Any]:
    """Return the object that `dumps` has written, without the checksum."""
    try:
        content = json.loads(data)
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    if not isinstance(content, dict) or content.pop(KEY, None) != _checksum(content):
        raise ValueError("the checksum does not agree")
    return content


def _checksum(content: dict[str, Any]) -> str:
    """Return the checksum of the values: spaces and the order of keys do not matter."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
