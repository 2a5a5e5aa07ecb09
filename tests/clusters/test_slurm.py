"""Runs on a SLURM cluster of this machine: jobs of two workers end in several ways, and are replaced."""

import subprocess
import sys
import time
from itertools import count
from pathlib import Path
from threading import Thread

import cloudpickle
import pytest
import yaml

from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, clusters
from flexroad.pipeline.execute.clusters import open_cluster
from flexroad.tools.synthetic.scenes import write_scenes
from tests.builders import LIGHT
from tests.dask_processes import until
from tests.slurm_daemons import slurm_daemons
from tests.whole_run import assert_whole, item_times

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

# Workers cannot import this test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])
TWO = {"kind": "slurm", "workers": 2, "per_job": 2, "memory": "1 GiB", "interface": "lo", "start_s": 100}


@pytest.fixture(scope="module")
def daemons():
    pytest.importorskip("dask_jobqueue")
    with slurm_daemons() as configuration:
        yield configuration


@pytest.fixture
def slurm(daemons, monkeypatch):
    """A cluster of SLURM; jobs are looked for each second."""
    monkeypatch.setenv("SLURM_CONF", str(daemons))
    monkeypatch.setattr("flexroad.pipeline.execute.slurm.CHECK_S", 1)


def jobs_of_slurm() -> list[str]:
    """Ids of the jobs that wait or run."""
    words = ["squeue", "--noheader", "--format=%A", "--states=PENDING,RUNNING"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()


def lost(job, why):
    return (job, why)


def nap(job):
    time.sleep(0.2)
    return job


def end_at_walltime(job):
    """Let the time limit of a job end now; SLURM looks at it twice a minute."""
    subprocess.run(["scontrol", "update", f"JobId={job}", "EndTime=now"], check=True)


def test_map_job_of_two_workers_ended_by_time_limit_is_submitted_again(slurm, tmp_path, monkeypatch):
    said = []
    # The wait for the next job is that for the first one.
    monkeypatch.setattr(clusters, "WORKER_LOST_TIMEOUT_S", 0)
    night = Cluster(**TWO)
    executor = DaskExecutor(cluster=night, notify=said.append, logs=tmp_path / "logs")

    def jobs():
        yield from range(4)
        (first,) = jobs_of_slurm()
        end_at_walltime(first)
        for number in count(4):
            yield number
            if jobs_of_slurm() not in ([first], []):
                return

    done = sorted(executor.map(nap, jobs(), lost))
    assert done == [*range(len(done))]
    assert "1 SLURM job ended; submitted again" in said
    assert len(list((tmp_path / "logs").glob("flexroad-*.err"))) == 2
    assert not jobs_of_slurm()


def test_run_job_of_two_workers_cancelled_equals_serial_run(slurm, tmp_path, flexroad):
    write_scenes(tmp_path / "survey", 12, seed=3, size_m=60)
    (tmp_path / "serial.yaml").write_text(yaml.safe_dump(LIGHT))
    (tmp_path / "slurm.yaml").write_text(yaml.safe_dump({"extends": "serial.yaml", "cluster": TWO}))
    catalog = ["--catalog", tmp_path / "survey" / "catalog.parquet"]
    serial, run = tmp_path / "serial", tmp_path / "run"
    flexroad("run", *catalog, "--out", serial, "--config", tmp_path / "serial.yaml").expected(0)

    def cancel_job_after_first_tile():
        until(lambda: item_times(run), 100)
        subprocess.run(["scancel", *jobs_of_slurm()], check=True)

    thread = Thread(target=cancel_job_after_first_tile)
    thread.start()
    said = flexroad("run", *catalog, "--out", run, "--config", tmp_path / "slurm.yaml").expected(0)
    thread.join()
    assert "1 SLURM job ended; submitted again" in said.err
    assert_whole(run, serial, killed=2)
    assert len(list((run / "logs").glob("flexroad-*.err"))) == 2
    assert not list(Path.cwd().glob("slurm-*.out"))


def mistaken(tmp_path, **options) -> tuple[str, list[str]]:
    """Return the message of the error of a cluster with wrong options, and the lines before."""
    said = []
    executor = DaskExecutor(cluster=Cluster(**TWO, **options), notify=said.append, logs=tmp_path / "logs")
    with pytest.raises(ConfigError) as caught:
        list(executor.map(nap, [1, 2], lost))
    assert not jobs_of_slurm()
    return str(caught.value), said


def test_map_jobs_that_sbatch_refuses_raise_its_words(slurm, tmp_path):
    message, _ = mistaken(tmp_path, queue="nowhere")
    assert "sbatch refuses the jobs: sbatch: error: invalid partition specified: nowhere" in message
    assert "\n" not in message


def test_map_jobs_that_end_before_a_worker_connects_are_given_up(slurm, tmp_path):
    message, said = mistaken(tmp_path, prologue=["echo no such module; exit 1"])
    assert message.startswith("the slurm cluster has no workers; `squeue --me` shows its jobs")
    assert said[:2] == ["1 SLURM job ended; submitted again"] * 2
    assert "1 SLURM job given up: 3 in a row ended before a worker connected" in said[2]
    outputs = [path.read_text() for path in (tmp_path / "logs").glob("flexroad-*.out")]
    assert outputs == ["no such module\n"] * 3


def test_cluster_of_slurm_refuses_who_has_no_certificate(slurm, tmp_path):
    from distributed import Client

    logs = tmp_path / "logs"
    with open_cluster(Cluster(**TWO), None, None, False, logs) as target:
        with Client(target.target, set_as_default=False) as client:
            client.wait_for_workers(2, 100)
            addresses = [target.target.scheduler_address, *client.nthreads()]
        assert (logs / ".certificates").stat().st_mode & 0o777 == 0o700
        for address in addresses:
            assert address.startswith("tls://")
            with pytest.raises(ConfigError, match="has no certificates"):
                list(DaskExecutor(scheduler=address).map(nap, [1], lost))
            with (
                pytest.raises(OSError, match="tcp://"),
                Client(address.replace("tls", "tcp"), timeout=1, set_as_default=False),
            ):
                pass
    assert not (logs / ".certificates").exists()
