"""GLB files by the Khronos validator."""

import json
import subprocess
from collections.abc import Iterable
from pathlib import Path

from tests import validators

SCRIPT = Path(__file__).with_name("validate_gltf.js")


def gltf_issues(files: Iterable[Path]) -> list[str]:
    """Return the errors and warnings of GLB files, with the name of the file."""
    command = [validators.node(), SCRIPT, validators.package("gltf-validator"), *files]
    done = subprocess.run(command, capture_output=True, check=True)
    issues = json.loads(done.stdout)
    return [
        f"{Path(file).name}: {issue['code']} {issue['message']}" for file in issues for issue in issues[file]
    ]
