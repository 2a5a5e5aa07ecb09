"""Soak tests run if something below them changed since the recorded commit."""

import subprocess
from types import SimpleNamespace

import pytest

from tests import changed
from tests.changed import AREAS, EVERYWHERE, ROOT, changed_files, is_due
from tests.conftest import pytest_terminal_summary, skip_unchanged

TEST = "tests/pipeline/run/test_kill.py"


def git(folder, *words):
    name = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    return subprocess.run(
        ["git", *name, *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout


def test_changed_files_are_those_since_the_recorded_commit(tmp_path):
    git(tmp_path, "init", "-q")
    for name in ("kept", "edited", "moved"):
        (tmp_path / name).write_text(f"{name}\n" * 9)
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    record = tmp_path / "passed"
    record.write_text(git(tmp_path, "rev-parse", "HEAD"))
    assert changed_files(tmp_path, record) == []
    git(tmp_path, "mv", "moved", "here")
    git(tmp_path, "commit", "-qm", "second")
    (tmp_path / "edited").write_text("")
    assert changed_files(tmp_path, record) == ["edited", "here", "moved"]


@pytest.mark.parametrize("commit", ["", "0" * 40, "no commit"])
def test_unknown_commit_makes_all_due(tmp_path, commit):
    git(tmp_path, "init", "-q")
    (tmp_path / "passed").write_text(commit)
    files = changed_files(tmp_path, tmp_path / "passed")
    assert files is None
    assert all(is_due(area, files) for area in AREAS)


@pytest.mark.parametrize(
    "file",
    [
        "pipeline/run/runner.py",
        "catalog/index.py",
        "pyproject.toml",
        "constraints.txt",
        "tests/faulty_files.py",
        "tests/tools/conftest.py",
        TEST,
    ],
)
def test_run_tests_are_due_after_a_change_of(file):
    assert is_due("runs", ["README.md", file], TEST)


def test_run_tests_are_not_due_after_changes_elsewhere():
    elsewhere = ["README.md", "tools/report/pages.py", "pipeline/runs.py", "viewer/page.js"]
    tests = ["tests/soak/passed", "bench/floors.py", "tests/pipeline/run/test_seal.py"]
    assert not is_due("runs", elsewhere + tests, TEST)
    assert not is_due("runs", [], TEST)
    assert is_due("pages", elsewhere)


def test_only_soak_tests_of_unchanged_areas_are_skipped():
    class Item(SimpleNamespace):
        path = ROOT / TEST

        def get_closest_marker(self, _name):
            return self.area and pytest.mark.soak(self.area).mark

        def add_marker(self, marker):
            assert marker.name == "skip"
            self.skipped = True

    items = [Item(area=area, skipped=False) for area in ("runs", "pages", None)]
    skip_unchanged(items, ["viewer/page.js"])
    assert [item.skipped for item in items] == [True, False, False]


@pytest.mark.parametrize(
    ("status", "process", "recorded"),
    [(0, {}, True), (1, {}, False), (0, {"workerinput": {}}, False)],
    ids=["passed", "failed", "parallel process"],
)
def test_commit_is_recorded_once_if_all_processes_passed(monkeypatch, status, process, recorded):
    lines, calls = [], []
    monkeypatch.setattr(changed, "record", lambda: calls.append(1) or "recorded")
    terminal = SimpleNamespace(stats={}, write_line=lines.append)
    options = SimpleNamespace(soak="record", keyword="")
    config = SimpleNamespace(option=options, args_source=pytest.Config.ArgsSource.TESTPATHS, **process)
    pytest_terminal_summary(terminal, status, config)
    assert lines == ["recorded"] * recorded
    assert len(calls) == recorded


def test_areas_name_what_exists():
    assert not [part for part in EVERYWHERE.union(*AREAS.values()) if not (ROOT / part).exists()]
