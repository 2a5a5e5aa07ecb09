"""Documentation: its commands run, links have targets, named tests exist, options are as in the models."""

import re
import shlex
from pathlib import Path

import pytest

from tests import options_page
from tests.command_line import call
from tests.make_backbone import save_backbone

ROOT = Path(__file__).parent.parent
NAMES = ("README.md", "CONTRIBUTING.md", "tests/faults.md")
PAGES = [*(ROOT / name for name in NAMES), *sorted((ROOT / "docs").rglob("*.md"))]
LIVE = [page for page in PAGES if page.parent in (ROOT, ROOT / "docs")]
NAMED_TEST = re.compile(r"`(test_\w+\.py)::(test_\w+)`")


def console_lines(page: Path) -> list[str]:
    blocks = re.findall(r"```console\n(.*?)```", page.read_text(), flags=re.DOTALL)
    return [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]


def anchors(page: Path) -> list[str]:
    """Return the names of a page's sections in links."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]


@pytest.mark.slow
def test_docs_commands_run(tmp_path, monkeypatch):
    """Those of three pages, in this order, in one folder; survey and scene are smaller."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flexroad.tools.synthetic.dsc3d.SIZE_M", 50)
    save_backbone(tmp_path / "dinov2-small", layers=4)
    (tmp_path / "points.csv").write_text("easting,northing\n500001,5600001\n")
    pages = ("data.md", "run.md", "results.md")
    lines = [line for name in pages for line in console_lines(ROOT / "docs" / name)]
    assert len(lines) > 30
    for line in lines:
        command, *words = shlex.split(line.replace("--tiles 4", "--tiles 2"))
        assert command == "flexroad"
        said = call(*words)
        assert said.code == 0, f"{line}\n{said.out}{said.err}"


@pytest.mark.slow
def test_readme_commands_and_code_run_in_empty_folder(tmp_path, monkeypatch):
    """The survey is smaller than README's."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text()
    section = text.partition("## Two minutes from nothing\n")[2].partition("\n## ")[0]
    commands = re.findall(r"^flexroad (.*)$", section, flags=re.MULTILINE)
    assert [line.split()[0] for line in commands] == ["catalog", "run", "report", "view"]
    smaller = {"catalog": ["--tiles", "2", "--tile-size", "60"], "run": ["--executor", "serial"]}
    for line in commands:
        words = shlex.split(line, comments=True)
        said = call(*words, *smaller.get(words[0], []))
        assert said.code == 0, f"{line}\n{said.out}{said.err}"
    for path in ("survey/catalog.parquet", "runs/survey/report.html", "runs/survey/viewer/index.html"):
        assert path in section
        assert Path(path).is_file()
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(code, names)
    assert Path("road.glb").is_file()
    assert names["run"].tiles.state.tolist() == 2 * ["done"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_have_targets(page):
    for target, section in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", page.read_text()):
        linked = page.parent / target if target else page
        assert linked.exists(), f"{page.name} links to {target}"
        if section and linked.suffix == ".md":
            assert section in anchors(linked), f"{page.name} links to {target}#{section}"


def test_readme_and_docs_stay_short():
    """Pages of results and of the archive, in folders of their own, do not count."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
    assert sum(len(page.read_text().split()) for page in (ROOT / "docs").glob("*.md")) <= 30_000


def test_options_are_those_of_the_models():
    assert options_page.PAGE.read_text() == options_page.page(), "run python -m tests.options_page"


@pytest.mark.parametrize("page", LIVE, ids=lambda page: page.name)
def test_named_files_and_modules_exist(page):
    text = page.read_text()
    files = re.findall(r"(?<![\w./])(?:catalog|pipeline|tasks|tools|tests|configs)/[\w/]+\.\w+", text)
    assert [name for name in files if "NAME" not in name and not (ROOT / name).exists()] == []
    modules = re.findall(r"flexroad\.((?:catalog|pipeline|tasks|tools)\.[\w.]+)", text)
    folders = [ROOT / name.rpartition(".")[0].replace(".", "/") for name in modules]
    assert [str(path) for path in folders if not (path.exists() or path.with_suffix(".py").exists())] == []


def test_way_of_one_tile_is_short():
    text = (ROOT / "docs" / "development.md").read_text()
    way = text.partition("## The way of one tile")[2].partition("\n## ")[0]
    assert 30 <= len(re.findall(r"^ *\w+/\S+\.py ", way, flags=re.MULTILINE)) <= 35


def test_faults_name_existing_tests():
    table = (ROOT / "tests" / "faults.md").read_text()
    rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 15
    assert [row for row in rows if not NAMED_TEST.search(row)] == []
    for file, test in NAMED_TEST.findall(table):
        exists = any(f"def {test}(" in path.read_text() for path in (ROOT / "tests").rglob(file))
        assert exists, f"no {file} has {test}"
