"""Clusters that run already, in real processes on loopback; and what is asked of SLURM and Kubernetes."""

import ctypes
import os
import sys
import time
from itertools import islice

import cloudpickle
import psutil
import pytest

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute import DaskExecutor
from flexroad.pipeline.execute.clusters import kubernetes_options, open_cluster, slurm_options
from tests.dask_processes import Processes, until, wait_for

pytestmark = pytest.mark.slow

# Workers have no tests to import.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

IMPATIENT = Cluster(patience_s=1)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    found = Processes(tmp_path_factory.mktemp("running"))
    found.scheduler()
    found.worker("--nworkers", "2")
    yield found
    found.end()


@pytest.fixture
def running(shared):
    """A cluster of two workers that tests share; whoever kills one gets it back from its nanny."""
    wait_for(shared.address, 2)
    return shared


def lost(job, why):
    return (job, why)


def double(job):
    return 2 * job


def deadly(job):
    """Die of the jobs that say so."""
    if str(job).startswith("segfault"):
        ctypes.string_at(0)
    if str(job).startswith("exit"):
        os._exit(3)
    time.sleep(0.02)
    return job


def test_jobs_are_made_as_there_is_room(running):
    taken, done = [], []

    def jobs():
        for job in range(40):
            taken.append(job)
            yield job

    for result in DaskExecutor(scheduler=running.address).map(double, jobs(), lost):
        done.append(result)
        # Two for each thread, one in hand.
        assert len(taken) <= len(done) + 5
    assert sorted(done) == [2 * job for job in range(40)]


def threads(job):
    """Tell what the process computes with, having loaded some more of it."""
    import numpy  # noqa: F401
    import torch
    from threadpoolctl import threadpool_info

    time.sleep(0.05)
    pools = [pool["num_threads"] for pool in threadpool_info()]
    return os.getpid(), max(pools), torch.get_num_threads(), os.environ["OMP_NUM_THREADS"]


def test_threads_are_pinned_also_of_a_worker_that_joins_later(processes):
    many = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "2")
    processes.scheduler()
    processes.worker("--preload", "numpy", **many)
    wait_for(processes.address, 1)

    def jobs():
        yield from range(3)
        processes.worker("--preload", "numpy", **many)
        wait_for(processes.address, 2)
        while len({pid for pid, *_ in found}) < 2:
            yield 0

    found = []
    for result in DaskExecutor(scheduler=processes.address).map(threads, jobs(), lost):
        found.append(result)
    assert len({pid for pid, *_ in found}) == 2
    assert {result[1:] for result in found} == {(1, 1, "1")}


@pytest.fixture
def other_numpy(tmp_path) -> dict[str, str]:
    """An environment in which numpy is said to be another."""
    (tmp_path / "numpy-1.0.dist-info").mkdir()
    (tmp_path / "numpy-1.0.dist-info" / "METADATA").write_text("Name: numpy\nVersion: 1.0\n")
    return {"PYTHONPATH": str(tmp_path)}


def refused(processes, jobs=(1, 2, 3), **options) -> str:
    with pytest.raises(ConfigError) as caught:
        list(DaskExecutor(scheduler=processes.address).map(double, jobs, lost, **options))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_cluster_that_cannot_do_the_work_is_refused(processes, other_numpy, monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.GRACE_S", 0)
    processes.scheduler()
    assert f"{processes.address} has no workers; start some" in refused(processes)
    unlike = processes.worker(**other_numpy)
    wait_for(processes.address, 1)
    told = refused(processes)
    assert "worker tcp://127.0.0.1" in told
    assert "numpy is 1.0 there and" in told
    assert "install the same there" in told
    unlike.terminate()
    unlike.wait(20)

    # One that joins later gets nothing to do, either.
    processes.worker()
    wait_for(processes.address, 1)

    def jobs():
        yield 1
        processes.worker(**other_numpy)
        wait_for(processes.address, 2)
        while True:
            yield 1

    assert "numpy is 1.0 there and" in refused(processes, jobs())


def test_a_store_that_workers_cannot_write_is_refused(running):
    here = os.getpid()

    def probe():
        if os.getpid() != here:
            raise OSError(30, "Read-only file system", "/store")

    told = refused(running, probe=probe)
    assert "worker tcp://127.0.0.1" in told
    assert "cannot use the store: /store: Read-only file system; mount it" in told


def test_nobody_answers(monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.dask.ANSWER_S", 1)
    with pytest.raises(ConfigError, match=r"scheduler at tcp://127.0.0.1:9 does not answer"):
        list(DaskExecutor(scheduler="tcp://127.0.0.1:9").map(double, [1], lost))


@pytest.mark.parametrize("poison", [["segfault"], ["exit 1", "segfault 2"]])
def test_a_job_that_kills_its_worker_is_lost_and_no_other(running, poison):
    """However patient the scheduler is, whose limit is 7 deaths."""
    jobs = [*range(10), *poison, *range(10, 20)]
    results = list(DaskExecutor(scheduler=running.address).map(deadly, jobs, lost))
    told = [result for result in results if isinstance(result, tuple)]
    assert sorted(job for job, _ in told) == poison
    assert all("died 2 times here" in why for _, why in told)
    assert sorted(result for result in results if isinstance(result, int)) == list(range(20))


def greedy(job):
    """Die, or take ever more memory, of the jobs that say so."""
    hoard = []
    while job == "greedy":
        hoard.append(b"x" * 20_000_000)
        time.sleep(0.02)
    return deadly(job)


def test_too_much_memory_on_the_only_worker_of_this_machine():
    small = Cluster(workers=1, memory="700 MiB")
    jobs = [1, 2, "greedy", 3, "exit 1", 4]
    results = list(DaskExecutor(cluster=small).map(greedy, jobs, lost))
    told = dict(result for result in results if isinstance(result, tuple))
    assert sorted(told) == ["exit 1", "greedy"]
    assert "at last for memory: it used" in told["greedy"]
    assert "may use 700.00 MiB" in told["greedy"]
    assert "at last for memory" not in told["exit 1"]
    assert sorted(result for result in results if isinstance(result, int)) == [1, 2, 3, 4]


def slow(job):
    time.sleep(0.1)
    return job


@pytest.mark.parametrize("who", ["scheduler", "workers"])
def test_whoever_stays_away_ends_the_run(processes, who):
    scheduler = processes.scheduler()
    worker = processes.worker("--no-nanny")
    wait_for(processes.address, 1)
    found = []

    def go_on():
        for result in DaskExecutor(scheduler=processes.address, cluster=IMPATIENT).map(slow, range(20), lost):
            found.append(result)
            if len(found) == 5:
                (scheduler if who == "scheduler" else worker).kill()

    with pytest.raises(ClusterLost, match="is gone$" if who == "scheduler" else "for 1 s"):
        go_on()
    assert found[:5] == [0, 1, 2, 3, 4]
    assert len(found) < 20


def kept(dask_scheduler) -> list[str]:
    return [*dask_scheduler.tasks, *dask_scheduler.worker_plugins, *dask_scheduler.plugins]


@pytest.mark.parametrize("wanted", [20, 1], ids=["whole", "interrupted"])
def test_nothing_of_a_run_stays_on_a_cluster(running, wanted):
    from distributed import Client

    with Client(running.address, set_as_default=False) as client:
        before = client.run_on_scheduler(kept)
        results = DaskExecutor(scheduler=running.address).map(slow, range(20), lost)
        next(results)
        assert len(client.run_on_scheduler(kept)) > len(before)
        assert len(list(islice(results, wanted - 1))) == wanted - 1
        results.close()
        until(lambda: client.run_on_scheduler(kept) == before)


def test_the_section_reaches_slurm():
    jobqueue = pytest.importorskip("dask_jobqueue")
    cluster = Cluster(
        kind="slurm", workers=6, per_job=3, memory="2 GiB", walltime_h=2.5, queue="night", account="roads",
        job_extra=["--exclusive"], prologue=["module load gdal"],
    )  # fmt: skip
    with jobqueue.SLURMCluster(**slurm_options(cluster, dashboard=False)) as made:
        script = made.job_script()
    lines = script.splitlines()
    assert {
        "#SBATCH -p night", "#SBATCH -A roads", "#SBATCH -n 1", "#SBATCH --cpus-per-task=3",
        "#SBATCH --mem=6G", "#SBATCH -t 02:30:00", "#SBATCH --exclusive", "module load gdal",
        "export OMP_NUM_THREADS=1", "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False",
    } <= set(lines)  # fmt: skip
    assert "--nthreads 1 --memory-limit 2.00GiB --nworkers 3 --nanny" in lines[-1]
    assert "--lifetime 8700s" in lines[-1]


def test_slurm_is_asked_for_workers_and_released(tmp_path, monkeypatch):
    """With commands that start and end jobs here, as SLURM would elsewhere."""
    pytest.importorskip("dask_jobqueue")
    jobs = tmp_path / "jobs"
    commands = {
        # Copied first, as SLURM does: who hands it in removes it at once.
        "sbatch": f'cp "$1" {jobs}.sh; setsid bash {jobs}.sh >/dev/null 2>&1 &\n'
        f"echo $! >>{jobs}; echo Submitted batch job $!",
        "scancel": 'kill -- -"$1"',
    }
    for name, text in commands.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    night = Cluster(kind="slurm", interface="lo", memory="2 GiB", start_s=60)
    assert sorted(DaskExecutor(cluster=night).map(double, range(5), lost)) == [0, 2, 4, 6, 8]
    started = [int(line) for line in jobs.read_text().split()]
    assert len(started) == 1
    until(lambda: not any(psutil.pid_exists(pid) for pid in started))


def test_the_section_reaches_kubernetes():
    operator = pytest.importorskip("dask_kubernetes.operator")
    cluster = Cluster(kind="kubernetes", workers=5, memory="2 GiB", image="roads:1")
    spec = operator.make_cluster_spec(**kubernetes_options(cluster))["spec"]
    assert spec["worker"]["replicas"] == 5
    (container,) = spec["worker"]["spec"]["containers"]
    assert container["image"] == "roads:1"
    assert container["resources"]["limits"] == {"cpu": "1", "memory": str(2 * 1024**3)}
    assert {"name": "OMP_NUM_THREADS", "value": "1"} in container["env"]
    assert container["args"][:4] == ["dask", "worker", "--nthreads", "1"]


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [("slurm", "there is no sbatch here"), ("kubernetes", r"pip install 'flexroad\[kubernetes\]'")],
)
def test_what_is_missing_is_named(kind, remedy, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "dask_kubernetes.operator", None)
    with pytest.raises(ConfigError, match=remedy), open_cluster(Cluster(kind=kind), None, None, False):
        pass


def test_who_works_changes_no_fingerprint(made_survey, tmp_path):
    from flexroad.catalog import Catalog
    from flexroad.pipeline.graph.graph import tile_graphs

    text = "extends: paper\ncluster: {kind: slurm, queue: night}\n"
    (tmp_path / "night.yaml").write_text(text)
    (tmp_path / "heir.yaml").write_text("extends: night.yaml\ncluster: {workers: 9}\n")
    heir = load_config(tmp_path / "heir.yaml")
    assert (heir.cluster.queue, heir.cluster.workers) == ("night", 9)
    catalog = Catalog.read(made_survey / "catalog.parquet")
    plain = [graph.fingerprint for graph in tile_graphs(catalog, load_config("paper"))]
    assert [graph.fingerprint for graph in tile_graphs(catalog, heir)] == plain
