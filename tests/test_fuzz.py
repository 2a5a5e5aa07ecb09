"""The fuzzer notices what it looks for: tracebacks, ends, hangs, texts that are no line, reads outside."""

import os
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from flexroad.tasks import TaskError
from tests.fuzz import reader
from tests.fuzz.__main__ import fuzz
from tests.fuzz.damage import damage, damage_text
from tests.fuzz.reader import Reader
from tests.fuzz.watch import outside

BEHAVIOURS = {
    "read": ("", True),
    "refuse": ("", False),
    "divide": ("ZeroDivisionError: ", False),
    "end": ("end of the process: 3", False),
    "print lines": ("TaskError that is no line: ", False),
    "hang": ("hang of 1 s", False),
    "grow": ("MemoryError: ", False),
}


def read(path: Path) -> None:
    """Do what a file says, as a reader with a fault would."""
    match path.read_text():
        case "refuse":
            raise TaskError("damaged; fetch it again")
        case "divide":
            raise ZeroDivisionError
        case "end":
            os._exit(3)
        case "print lines":
            raise TaskError("a\nb")
        case "hang":
            time.sleep(60)
        case "grow":
            np.ones(reader.MEMORY, np.uint8)


def test_reader_tells_faults_from_errors(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "SECONDS", 1)
    monkeypatch.setattr(reader, "START_SECONDS", 100)
    with Reader(__name__, "read") as process:
        for behaviour, (fault, was_read) in BEHAVIOURS.items():
            path = tmp_path / "file"
            path.write_text(behaviour)
            result = process.read(path)
            assert result.fault.startswith(fault) if fault else not result.fault, (behaviour, result)
            assert result.was_read == was_read


def test_reads_outside_are_noticed(tmp_path):
    with outside(tmp_path / "outside") as watched:
        assert watched.touched() == ""
        (tmp_path / "outside" / "secret.json").read_text()
        assert watched.touched() == "read outside: secret.json"
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(f"{watched.server.url}/a.tif")
        assert watched.touched() == "read outside: GET /a.tif"
        assert watched.touched() == ""


def test_damage_changes_most_copies_and_repeats_by_seed():
    data, text = bytes(range(256)) * 4, 'a: "b"\nc: {d: 1.5}\n'
    for make in (lambda rng: damage(data, rng), lambda rng: damage_text(text, rng, ["/outside"])):
        copies = [make(np.random.default_rng(seed)) for seed in range(200)]
        assert copies == [make(np.random.default_rng(seed)) for seed in range(200)]
        assert len(set(copies)) > 100
        assert sum(copy in (data, text.encode()) for copy in copies) < 40


def make(folder: Path) -> list[Path]:
    (folder / "file").write_text("read")
    return [folder / "file"]


def change(path: Path, data: bytes, rng: np.random.Generator) -> bytes:
    return rng.choice([b"refuse", b"divide"])


def test_fuzz_keeps_files_with_a_fault(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tests.fuzz.targets.made_up", sys.modules[__name__])
    outcome = fuzz("made_up", 2, 1, tmp_path / "kept")
    kept = [path.read_text() for path in (tmp_path / "kept" / "made_up").iterdir()]
    assert outcome.counts["fault"] == len(outcome.faults) >= len(kept) > 0
    assert outcome.counts["refused"] > 0 == outcome.counts["read"]
    assert set(kept) == {"divide"}
