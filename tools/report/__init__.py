"""``flexroad report``: a run as Markdown, CSV, or one HTML page with a map and pictures.

For users who decide whether a run can be delivered. Start at `write_report` below, then `content.gather`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import pandas as pd

from flexroad.catalog.storage.paths import Location, exists, is_remote, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked
from flexroad.pipeline.store.tables import PREVIOUS, read_metrics
from flexroad.tools.report.browser.page import html_page
from flexroad.tools.report.content import gather
from flexroad.tools.report.pages import csv_page, markdown_page

Format = Literal["md", "csv", "html"]
VIEWER, PAGE = "viewer", "index.html"
"""Folder in RUN where a 3D viewer is searched, and its page."""
LAST = "the state before the last run"
"""Name of the earlier state of the run."""


def write_report(
    run: Run,
    form: Format,
    track: Track = untracked,
    viewer: Location | None = None,
    compared: Location | None = None,
) -> Location:
    """Write RUN/report.<form> and return its path.

    - `viewer`: folder of `flexroad view` for the links of an HTML report; by default RUN/viewer if it exists.
    - `compared`: another run over the same tiles, for the comparison in an HTML report; by default this run
      before its last execution.
    """
    address = _viewer_address(run, viewer) if form == "html" else ""
    before = _before(run, compared) if form == "html" else None
    content = gather(run, track)
    if form == "html":
        text = html_page(run, content, address, before, track)
    else:
        text = {"md": markdown_page, "csv": csv_page}[form](content)
    path = run.path / f"report.{form}"
    write(path, text.encode())
    return path


def _before(run: Run, compared: Location | None) -> tuple[str, pd.DataFrame] | None:
    """Return name and rows of the run to compare with; None without such a run."""
    if compared is not None:
        return compared.name, read_metrics(Run.open(compared, run.allowed).path)
    if not exists(run.path / PREVIOUS):
        return None
    return LAST, read_metrics(run.path, PREVIOUS)


def _viewer_address(run: Run, folder: Location | None) -> str:
    """Return the address of the viewer's page relative to RUN; empty without a viewer."""
    if folder is None:
        return f"{VIEWER}/{PAGE}" if exists(run.path / VIEWER / PAGE) else ""
    if not exists(folder / PAGE):
        raise ConfigError(f"{folder} has no {PAGE}; make it with `flexroad view {run.path} -o {folder}`")
    if is_remote(folder) or is_remote(run.path):
        return str(folder / PAGE)
    return quote(Path(os.path.relpath(str(folder / PAGE), str(run.path))).as_posix())
