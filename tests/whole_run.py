"""Comparison of a run with an undisturbed one."""

import json
from pathlib import Path

import pandas as pd

from flexroad.pipeline.store.tables import read_metrics


def rows(out: Path) -> pd.DataFrame:
    return read_metrics(out).drop(columns="seconds")


def products(out: Path) -> dict[str, bytes]:
    """The contents of all tile files except the markers, which contain times."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in out.glob("tiles/*/*")
        if path.suffix != ".json"
    }


def times(out: Path) -> dict[str, int]:
    """Modification time of each product, marker and artefact (ns)."""
    paths = (path for part in ("tiles", "store") for path in (out / part).rglob("*") if path.is_file())
    return {path.relative_to(out).as_posix(): path.stat().st_mtime_ns for path in paths}


def temporary_files(out: Path) -> list[Path]:
    """Files with a name that starts with a dot, as only those have that are not complete yet."""
    return [path for path in out.rglob(".*") if path.is_file()]


def item_times(out: Path) -> dict[Path, int]:
    """Modification time of each marker of a finished tile (ns)."""
    return {path: path.stat().st_mtime_ns for path in out.glob("tiles/*/item.json")}


def assert_equal(out: Path, other: Path) -> None:
    pd.testing.assert_frame_equal(rows(out), rows(other), check_exact=True)
    assert products(out) == products(other)


def assert_whole(out: Path, undisturbed: Path, killed: int = 0) -> None:
    """The run equals the undisturbed one, without a lock; a killed worker may leave one temporary file."""
    assert_equal(out, undisturbed)
    assert json.loads((out / "summary.json").read_text())["exit_code"] == 0
    assert len(temporary_files(out)) <= killed
    assert not (out / "lock.json").exists()
