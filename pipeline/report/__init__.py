"""Reports on a run as Markdown, CSV, or one HTML file with pictures."""

from __future__ import annotations

from typing import Literal

from flexroad.catalog.storage.paths import Location, write
from flexroad.pipeline.report.content import gather
from flexroad.pipeline.report.pages import csv_page, html_page, markdown_page
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked

Format = Literal["md", "csv", "html"]


def write_report(run: Run, form: Format, track: Track = untracked) -> Location:
    """Write RUN/report.<form> and return its path.

    Parameters
    ----------
    form : {"md", "csv", "html"}
    track : callable
        Shows the progress of each step.

    Raises
    ------
    ConfigError
        If the run has no rows yet.
    """
    content = gather(run, track)
    if form == "html":
        from flexroad.pipeline.report.pictures import tile_pictures

        text = html_page(content, tile_pictures(run, content, track))
    else:
        text = {"md": markdown_page, "csv": csv_page}[form](content)
    path = run.path / f"report.{form}"
    write(path, text.encode())
    return path
