"""Pages show texts from files as they are, and never obey markup or control characters in them."""

from dataclasses import replace

import pandas as pd
from markdown_it import MarkdownIt

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.report.content import gather
from flexroad.tools.report.pages import markdown, markdown_page, template
from tests.builders import LIGHT

EVIL = "\x1b[2J<img src=x>`a` *b* _c_ [d](e) f|g ~h~ &amp; \nx"


def test_markdown_escapes_markup_and_controls():
    table = markdown(pd.DataFrame([(EVIL, "295500_5629250", 1.5)], columns=["message", "tile", "m"]))
    *_, row = table.splitlines()
    assert row == (
        r"| \\x1b[2J&lt;img src=x>\`a\` \*b\* \_c\_ [d\](e) f\|g \~h\~ &amp;amp; \\nx "
        "| 295500_5629250 | 1.500 |"
    )


def test_markdown_keeps_intervals():
    assert "| 0.1 [0.0, 0.2] |" in markdown(pd.DataFrame([("0.1 [0.0, 0.2]",)], columns=["a"]))


def test_html_escapes_markup_and_controls(tmp_path):
    (tmp_path / "x.j2").write_text("<p>{{ text }}</p>{{ table | table }}")
    page = template("x.j2", tmp_path).render(text=EVIL, table=pd.DataFrame({"a": [EVIL]}))
    assert "<img" not in page
    assert all(line.isprintable() for line in page.split("\n"))
    assert page.startswith(r"<p>\x1b[2J&lt;img src=x&gt;`a`")
    assert "<table>" in page


def test_report_of_a_run_with_markup_in_its_texts_has_no_html(survey, tmp_path):
    """Ids, options, versions and data sets come from files."""
    evil = "<script>alert(1)</script>"
    given = Catalog.read(survey).tiles
    tiles = tuple(replace(tile, id=f"{evil}{n}", dataset=evil) for n, tile in enumerate(given))
    tiles[0].paths(tiles[0].layers[0])[0].unlink()
    config = compose(LIGHT | {"dataset": {"name": evil}}, evil)
    run = Run.create(tmp_path / "run", config, Catalog(tiles))
    run_tiles(run, SerialExecutor())
    page = markdown_page(gather(replace(run, versions={"flexroad": evil})))
    assert page.count("&lt;script>") > 10
    before, _, rest = page.partition("```yaml")
    assert "<script" not in before + rest.rpartition("```")[2]
    assert "<script" not in MarkdownIt("commonmark").enable("table").render(page)
