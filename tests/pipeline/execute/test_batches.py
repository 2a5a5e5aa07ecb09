"""Jobs of three steps: alone, in batches, alone; executed serially and on a cluster with a GPU worker."""

import os
import sys
from functools import partial

import cloudpickle
import pytest

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import BatchExecutor, DaskExecutor, Ready, SerialExecutor
from tests.dask_processes import wait_for

# Workers cannot import this test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def prepared(job):
    """Jobs are numbers in groups of even and odd ones; 7 needs no batch."""
    return "alone 7" if job == 7 else Ready(job, job % 2)


def batch(jobs, seen=None):
    if seen is not None:
        seen.append(jobs)
    return [f"{job} of {len(jobs)}" for job in jobs]


def finished(job):
    return f"done {job}"


def lost(job, why):
    return f"lost {job}: {why}"


def test_serial_jobs_take_three_steps_in_batches_of_one_group():
    seen = []
    executor = BatchExecutor(SerialExecutor(), prepared, partial(batch, seen=seen), 3)
    results = list(executor.map(finished, range(10), lost))
    assert sorted(job for jobs in seen for job in jobs) == [0, 1, 2, 3, 4, 5, 6, 8, 9]
    assert max(map(len, seen)) == 3
    assert all(len({job % 2 for job in jobs}) == 1 for jobs in seen)
    assert len(results) == 10
    assert "alone 7" in results
    assert "done 0 of 3" in results


def test_serial_without_jobs_gives_nothing():
    assert list(BatchExecutor(SerialExecutor(), prepared, batch, 3).map(finished, [], lost)) == []


def test_serial_job_of_a_group_of_its_own_is_a_batch_of_one():
    executor = BatchExecutor(SerialExecutor(), lambda job: Ready(job, job), batch, 2)
    assert sorted(executor.map(finished, range(9), lost)) == [f"done {job} of 1" for job in range(9)]


class Dying:
    """An executor on which batches with a number die."""

    def __init__(self, number):
        self.number = number

    def map(self, function, jobs, lost, probe=None):
        for step in jobs:
            dies = self.number in getattr(step, "jobs", ())
            yield lost(step, "its worker died") if dies else function(step)


def test_batch_whose_worker_dies_is_halved_down_to_the_job_itself():
    seen = []
    executor = BatchExecutor(Dying(4), lambda job: Ready(job, 0), partial(batch, seen=seen), 8)
    results = sorted(executor.map(finished, range(8), lost))
    assert sorted(map(len, seen)) == [1, 2, 4]
    assert results[-1] == "done 7 of 2"
    assert "done 4" in results
    assert len(results) == 8


def here(jobs):
    """Return the jobs with the process of the batch; a batch of several with job 4 ends its worker."""
    if 4 in jobs and len(jobs) > 1:
        os._exit(3)
    return [(job, os.getpid()) for job in jobs]


def with_process(job):
    return (*job, os.getpid()) if isinstance(job, tuple) else (job, None, os.getpid())


@pytest.mark.slow
def test_dask_batches_run_on_the_worker_with_a_gpu_and_survive_its_death(processes):
    processes.scheduler()
    processes.worker("--name", "plain")
    wait_for(processes.address, 1)
    parallel = DaskExecutor(scheduler=processes.address, gpu=True)
    executor = BatchExecutor(parallel, lambda job: Ready(job, 0), here, 4)
    with pytest.raises(ConfigError, match="no worker with the resource GPU; start one"):
        list(executor.map(with_process, range(6), lost))
    processes.worker("--resources", "GPU=1")
    wait_for(processes.address, 2)
    results = list(executor.map(with_process, range(12), lost))
    assert sorted(job for job, *_ in results) == list(range(12))
    # A nanny has replaced the worker with the GPU, which fitted in all batches.
    fitted_by = {pid for _, pid, _ in results if pid}
    assert 1 <= len(fitted_by) <= 3
    assert {pid for *_, pid in results} - fitted_by


@pytest.mark.slow
def test_dask_local_cluster_has_one_worker_with_a_gpu():
    executor = BatchExecutor(DaskExecutor(2, gpu=True), lambda job: Ready(job, 0), here, 2)
    results = list(executor.map(with_process, [0, 1, 2, 3, 5, 6, 7, 8], lost))
    assert sorted(job for job, *_ in results) == [0, 1, 2, 3, 5, 6, 7, 8]
    assert len({pid for _, pid, _ in results}) == 1
