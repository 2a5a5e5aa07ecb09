"""Jobs in flight on one Dask scheduler.

If a worker dies, all jobs that were assigned to it fail, and it is unknown which job caused the death. All of
them are quarantined: they run last, one at a time on a worker. A job that then exceeds the memory or the time
of its worker is lost. If its worker dies again for an unknown reason, another job of the machine may have
taken its memory. So the job runs once more with no other job at the same time. It is lost if its worker dies
a third time.

A worker that fails its check is left out: one line says why, and its jobs go to other workers. If no worker
passes, or workers die for memory before any job was done, the session ends.
"""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count, islice
from typing import Any, Generic

from dask.utils import format_bytes, key_split
from distributed import Client, Future
from distributed.protocol.pickle import dumps
from distributed.scheduler import KilledWorker, NoValidWorkerError, NoWorkerError

from flexroad.catalog.text import Notify
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.executor import J, Probe, R
from flexroad.pipeline.execute.workers import Admission, task_function, work

FORGET_KEYS_EVERY = 1000
"""Number of jobs after which Dask's cache of key names is cleared: it has 0.4 KB for each job."""
TICK_S = 1.0
"""Interval between checks of the scheduler and the workers (s)."""
LONGEST_STEP_S = 5 * TICK_S
"""Longest time between two checks that is counted as waiting (s): a suspended machine makes clocks jump."""
DEADLY = 20
"""The session ends when this many workers, or twice the number of threads if that is more, have died for lack
of memory before any job was done. Fewer deaths may come from a few large tiles at the start."""


@dataclass(frozen=True)
class InFlight(Generic[J]):
    """A job that was submitted."""

    job: J
    workers: tuple[str, ...] = ()
    """Addresses of the workers that may run it; empty if any may."""
    reserved: bool = False
    """Whether it was quarantined: it has one worker, which runs nothing else."""
    alone: bool = False
    """Whether no other job runs at the same time."""
    accepted: bool = False
    """Whether the proof of its only worker was accepted."""
    submitted: float = field(default_factory=time.monotonic)


@dataclass(eq=False)
class Session(Generic[J, R]):
    """Submits jobs over one connection and collects their results."""

    client: Client
    """It has a `WorkerCheck` on every worker and a `retry_blocker` on the scheduler."""
    name: str
    """The scheduler's name in messages."""
    check: str
    """Name of the `WorkerCheck`; part of the task keys, so that they are unique to this session."""
    function: Callable[[J], R]
    jobs: Iterator[J]
    """The jobs; they are taken one by one when there is room."""
    lost: Callable[[J, str], R]
    worker_lost_timeout_s: float
    """How long to wait for a worker when no worker is left (s)."""
    limit_s: float
    """Longest time of a job (s)."""
    notify: Notify
    probe: Probe | None = None
    """The probe of the `WorkerCheck`."""
    quarantined: deque[J] = field(default_factory=deque)
    """Jobs that were assigned to a worker that died."""
    suspects: deque[J] = field(default_factory=deque)
    """Quarantined jobs whose worker died again for an unknown reason."""
    returned: deque[J] = field(default_factory=deque)
    """Jobs that a worker could not take."""
    done: int = 0
    """Number of results."""
    died: set[str] = field(default_factory=set)
    """Addresses of workers that died before there was a result."""
    in_flight: dict[Future, InFlight[J]] = field(default_factory=dict)
    completed: queue.SimpleQueue[Future] = field(default_factory=queue.SimpleQueue)
    numbers: Iterator[int] = field(default_factory=partial(count, 1))
    workers: dict[str, int] = field(default_factory=dict)
    """Number of threads by worker address, at ``checked_at``."""
    checked_at: float = 0.0
    without_worker_s: float | None = None
    """Time for which checks found no workers (s); None if there are workers."""

    def __post_init__(self) -> None:
        self.admission, self.run_task = Admission(self.probe, self.notify), task_function()

    def results(self) -> Iterator[R]:
        """Yield results as jobs finish, until nothing is left to do."""
        while True:
            self._check_cluster()
            self._submit_jobs()
            if not (self.in_flight or self.returned or self.quarantined or self.suspects):
                return
            for future in self._take_completed():
                yield from self._outcome(future, self.in_flight.pop(future))
                future.release()

    def _submit_jobs(self) -> None:
        reserved = {flight.workers[0] for flight in self.in_flight.values() if flight.reserved}
        if not reserved:
            # Any worker may take a job, so that later workers get jobs too, unless a worker is left out.
            allowed = tuple(self.workers) if self.admission.left_out else ()
            while self.returned and self.workers:
                self._submit(InFlight(self.returned.popleft(), allowed))
            # Twice the number of threads keeps all workers busy at constant memory.
            room = max(2, 2 * sum(self.workers.values())) - len(self.in_flight) - len(self.returned)
            for job in islice(self.jobs, max(0, room)):
                self._submit(InFlight(job, allowed))
        if len(self.in_flight) == len(reserved):
            for address in [address for address in self.workers if address not in reserved]:
                if self.quarantined:
                    self._submit(InFlight(self.quarantined.popleft(), (address,), reserved=True))
        if self.suspects and self.workers and not self.in_flight:
            worker = (next(iter(self.workers)),)
            self._submit(InFlight(self.suspects.popleft(), worker, reserved=True, alone=True))

    def _submit(self, flight: InFlight[J]) -> None:
        name = getattr(flight.job, "key", None) or self.function.__name__.strip("_")
        number = next(self.numbers)
        if number % FORGET_KEYS_EVERY == 0:
            key_split.cache_clear()
        # Keys are numbered: Dask would return the old error for a failed key. Jobs write files: not pure.
        future = self.client.submit(
            self.run_task,
            dumps((partial(work, limit_s=self.limit_s), self.function, flight.job)),
            self.check,
            flight.accepted,
            key=f"{name}-{self.check}-{number}",
            pure=False,
            workers=flight.workers or None,
        )
        self.in_flight[future] = flight
        future.add_done_callback(self.completed.put)

    def _take_completed(self) -> list[Future]:
        """Return the futures that completed; wait for the first one for at most ``TICK_S``."""
        try:
            futures = [self.completed.get(timeout=TICK_S)]
        except queue.Empty:
            return []
        while not self.completed.empty():
            futures.append(self.completed.get())
        return [future for future in futures if future in self.in_flight]

    def _check_cluster(self) -> None:
        """Update the list of workers, at most once per ``TICK_S``."""
        if self.workers and time.monotonic() < self.checked_at + TICK_S:
            return
        if self.client.status != "running":
            # A request would only end with a timeout.
            raise self._cluster_lost()
        try:
            self.workers = self.admission.able(self.client.nthreads())
        except OSError as error:
            raise self._cluster_lost() from error
        now = time.monotonic()
        # A machine that was suspended for an hour did not wait for an hour.
        since_last_check = min(now - self.checked_at, LONGEST_STEP_S)
        self.checked_at = now
        self._wait_for_workers(since_last_check)
        for future, flight in list(self.in_flight.items()):
            if flight.workers and self.workers.keys().isdisjoint(flight.workers) and not future.done():
                # The only workers that may run it died before the job started.
                self._return(self.in_flight.pop(future))
                future.release()

    def _wait_for_workers(self, since_last_check: float) -> None:
        if self.workers:
            self.without_worker_s = None
        elif self.without_worker_s is None:
            self.without_worker_s = 0.0
            self.notify(f"no worker is left; waiting up to {self.worker_lost_timeout_s:g} s for one")
        else:
            self.without_worker_s += since_last_check
            if self.without_worker_s > self.worker_lost_timeout_s:
                raise self._no_worker()

    def _no_worker(self) -> ClusterLost | ConfigError:
        text = f"no worker was left for {self.worker_lost_timeout_s:g} s"
        for fault in self.admission.left_out.values():
            # There are workers, but no result yet: the run could not start.
            return (ClusterLost if self.done else ConfigError)(f"{text}; {fault}")
        return ClusterLost(text)

    def _outcome(self, future: Future, flight: InFlight[J]) -> Iterator[R]:
        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            yield from self._worker_died(flight, error)
        elif isinstance(error, NoWorkerError | NoValidWorkerError):
            # A scheduler may be configured to fail tasks without workers; here the timeout decides.
            self._return(flight)
        elif future.status == "error":
            future.result()
        elif future.status == "finished":
            yield from self._fetch(future, flight)
        else:
            self._cancelled(flight)

    def _fetch(self, future: Future, flight: InFlight[J]) -> Iterator[R]:
        try:
            address, host, fault, proof, result = self._result(future)
        except KilledWorker as error:
            # The worker died after the job, before its result was transferred.
            yield from self._worker_died(flight, error)
        except (CancelledError, OSError):
            self._cancelled(flight)
        else:
            if not self.admission.accepts(address, host, fault, proof):
                self.workers.pop(address, None)
                self._return(flight)
            elif proof is not None:
                # The job is sent only to this worker, to tell it that it is accepted.
                self._submit(replace(flight, workers=(address,), accepted=True, submitted=time.monotonic()))
            else:
                self.done += 1
                yield result

    def _result(self, future: Future) -> Any:
        """Return the result of a finished job."""
        while True:
            try:
                return future.result(TICK_S)
            except TimeoutError:
                # A live worker may take long to answer, because a library may block its interpreter.
                if future.status != "finished":
                    raise

    def _cancelled(self, flight: InFlight[J]) -> None:
        """Quarantine a job without a result; raise an error if the scheduler is not connected any more."""
        if self.client.status != "running":
            raise self._cluster_lost()
        # The worker died before its result was fetched.
        self._again(flight)

    def _again(self, flight: InFlight[J]) -> None:
        """Queue a job again whose worker may have died while it ran."""
        (self.suspects if flight.alone else self.quarantined).append(flight.job)

    def _return(self, flight: InFlight[J]) -> None:
        """Queue a job again that did not start."""
        if flight.reserved:
            self._again(flight)
        else:
            self.returned.append(flight.job)

    def _worker_died(self, flight: InFlight[J], error: KilledWorker) -> Iterator[R]:
        if not self.done:
            self.died.add(error.last_worker.address)
            self._check_deaths(error)
        if not flight.reserved:
            self.quarantined.append(flight.job)
        elif (reason := self._own_fault(flight, error)) or flight.alone:
            unknown = "the worker process died 3 times here; too little memory is the usual cause"
            yield self.lost(flight.job, reason or unknown)
        else:
            self.suspects.append(flight.job)

    def _cluster_lost(self) -> ClusterLost:
        return ClusterLost(f"{self.name} is gone")

    def _own_fault(self, flight: InFlight[J], error: KilledWorker) -> str:
        """Return why the job itself ended its reserved worker, empty if that is unknown."""
        times = 3 if flight.alone else 2
        # A reserved worker starts its job at once.
        if time.monotonic() - flight.submitted >= self.limit_s:
            return (
                f"it took more than {self.limit_s:g} s, {times} times, and was stopped; look at its source "
                "files, or raise cluster.tile_timeout_s"
            )
        worker = error.last_worker
        if worker.address in (used := self._used_memory()):
            return (
                f"the worker process died {times} times here, at last for memory: it used "
                f"{format_bytes(used[worker.address])} and may use {format_bytes(worker.memory_limit)}; "
                "give each worker more (cluster: memory, fewer --workers)"
            )
        return ""

    def _used_memory(self) -> dict[str, int]:
        """Return the used memory (bytes) of the workers that died for lack of memory, by address."""
        events = self.client.get_events("worker-restart-memory") or ()
        return {event["worker"]: event["rss"] for _, event in events}

    def _check_deaths(self, error: KilledWorker) -> None:
        """Raise an error if too many workers died for lack of memory before any job was done."""
        if len(self.died) < max(DEADLY, 2 * sum(self.workers.values())):
            return
        if self.died <= self._used_memory().keys():
            limit = format_bytes(error.last_worker.memory_limit)
            raise ConfigError(
                f"{len(self.died)} worker processes died one after another because their tiles need more "
                f"memory than they may use ({limit}), and no tile was done; give each worker more "
                "(cluster.memory, fewer --workers), or make the catalog with smaller tiles (--tile-size)"
            )
