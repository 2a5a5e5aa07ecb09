"""Reports on a run as Markdown, CSV, or one HTML file with pictures."""

from __future__ import annotations

from typing import Literal

from flexroad.catalog.storage.paths import Location, write
from flexroad.pipeline.report.content import gather
from flexroad.pipeline.report.pages import csv_page, html_page, markdown_page
from flexroad.pipeline.run.record import Run

Format = Literal["md", "csv", "html"]


def write_report(run: Run, form: Format) -> Location:
    """Write RUN/report.<form> and return its path.

    Parameters
    ----------
    form : {"md", "csv", "html"}

    Raises
    ------
    ConfigError
        If the run has no rows yet.
    """
    content = gather(run)
    if form == "html":
        from flexroad.pipeline.report.pictures import tile_pictures

        text = html_page(content, tile_pictures(run, content))
    else:
        text = {"md": markdown_page, "csv": csv_page}[form](content)
    path = run.path / f"report.{form}"
    write(path, text.encode())
    return path
