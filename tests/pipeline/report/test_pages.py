"""Pages show texts from files as they are, and never obey markup or control characters in them."""

import pandas as pd

from flexroad.pipeline.report.pages import markdown, template

EVIL = "\x1b[2J<img src=x>`a` *b* _c_ [d](e) f|g ~h~ &amp; \nx"


def test_markdown_escapes_markup_and_controls():
    table = markdown(pd.DataFrame([(EVIL, "295500_5629250", 1.5)], columns=["message", "tile", "m"]))
    *_, row = table.splitlines()
    assert row == (
        r"| \\x1b[2J\<img src=x>\`a\` \*b\* \_c\_ [d\](e) f\|g \~h\~ \&amp; \\nx | 295500_5629250 | 1.500 |"
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
