"""The proof that a worker has the client's run, store and sources; both are this process."""

import errno
import os
import pickle
import shutil
from dataclasses import replace

import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.worker.shared_files import SharedFiles


@pytest.fixture
def run(survey, tmp_path):
    return Run.create(tmp_path / "run", compose({}, "paper"), Catalog.read(survey))


@pytest.fixture
def job(run):
    return run.job(run.graph(run.catalog.tiles[0]))


@pytest.fixture
def shared(run):
    with SharedFiles((str(run.path), str(run.store))) as shared:
        yield shared


def left(run) -> list[str]:
    """The names of the files of proofs that are there."""
    return [path.name for folder in (run.path, run.store) for path in folder.glob(".probe-*")]


def test_worker_with_the_same_files_is_accepted_and_leaves_none(run, job):
    with SharedFiles((str(run.path), str(run.store))) as shared:
        proof = pickle.loads(pickle.dumps(shared)).answer(job)
        assert len(left(run)) == 4
        shared.accept(pickle.loads(pickle.dumps(proof)))
        assert left(run) == [shared.name] * 2
        # Its client does not take this one any more.
        shared.answer(job)
        other = run.path / f".probe-{'0a' * 16}"
        other.touch()
    assert left(run) == [other.name]


@pytest.mark.parametrize("name", ["path", "store"])
def test_worker_with_another_folder_is_refused_and_leaves_no_file(name, run, job, shared):
    folder = getattr(run, name)
    (folder / shared.name).unlink()
    with pytest.raises(
        OSError, match=f"^{folder} is not the same folder there as here; mount it there under"
    ):
        shared.answer(job)
    assert left(run) == [shared.name]


def test_worker_that_cannot_write_is_refused(run, job, shared, monkeypatch):
    def refuse(where, data):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(where))

    monkeypatch.setattr(paths, "write", refuse)
    with pytest.raises(OSError, match=f"^{run.path}: Read-only file system; make it readable and writable"):
        shared.answer(job)


@pytest.mark.parametrize("name", ["path", "store"])
def test_worker_whose_files_do_not_arrive_is_refused(name, run, job, shared):
    proof = shared.answer(job)
    (getattr(run, name) / proof[0]).unlink()
    with pytest.raises(OSError, match=f"^what it writes to {getattr(run, name)} does not arrive here"):
        shared.accept(proof)
    assert left(run) == [shared.name] * 2


@pytest.mark.parametrize("state", ["missing", "older"])
def test_worker_with_other_sources_is_refused(state, run, job, shared, tmp_path):
    """Only the DTM differs: each folder is looked at."""
    folder = run.catalog.tiles[0].paths(run.catalog.tiles[0].layer("dtm"))[0].parent
    shutil.copytree(folder, tmp_path / "here")
    for file in folder.iterdir():
        file.unlink() if state == "missing" else os.utime(file, (1, 1))
    proof = shared.answer(job)
    shutil.rmtree(folder)
    shutil.copytree(tmp_path / "here", folder)
    what = {"missing": "does not exist", "older": "has another size or time"}[state]
    with pytest.raises(OSError, match=f"^{folder}/.*.tif {what} there; mount it there under the same path$"):
        shared.accept(proof)


def test_worker_is_accepted_if_a_source_has_changed_or_is_missing_here_too(run, job, shared):
    """As of a file that is uploaded while the run starts: its tile says so."""
    file = run.catalog.tiles[0].paths(run.catalog.tiles[0].layer("dsm"))[0]
    os.utime(file, (1, 1))
    shared.accept(shared.answer(job))
    graph = replace(job.graph, file_stats={"/nowhere/a.tif": None})
    proof = shared.answer(replace(job, graph=graph))
    assert proof[1] == {}
    shared.accept(proof)


@pytest.mark.slow
def test_proof_in_bucket_is_found_and_removed(run, job, bucket):
    with SharedFiles((str(bucket / "run"), str(bucket / "run" / "store"))) as shared:
        shared.accept(shared.answer(job))
        assert len(paths.listing(bucket / "run")) == 2
    assert paths.listing(bucket / "run") == {}
    with pytest.raises(OSError, match="is not the same folder there as here"):
        shared.answer(job)
