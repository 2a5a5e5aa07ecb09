"""A window of jobs in flight on a scheduler.

A worker that dies takes with it every job it had been given. Which of them killed it nobody knows, so all
of them are suspects and are done last, one at a time on a worker: whoever loses its worker there is lost.
"""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import count, islice
from typing import Generic

from dask.utils import format_bytes
from distributed import Client, Future
from distributed.protocol.pickle import dumps
from distributed.scheduler import KilledWorker, NoValidWorkerError, NoWorkerError

from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.executor import J, R
from flexroad.pipeline.execute.scheduler import carrier
from flexroad.pipeline.execute.workers import work

TICK_S = 1.0
"""How long nothing must happen before one looks whether scheduler and workers are there."""


@dataclass(frozen=True)
class InFlight(Generic[J]):
    """A job on its way."""

    job: J
    alone: str = ""
    """Address of the worker it has for itself, being suspect."""


class Session(Generic[J, R]):
    """Does jobs over one connection.

    Parameters
    ----------
    client : distributed.Client
        With a `Guard` on every worker and a `no_second_try` on the scheduler.
    name : str
        What the scheduler is called in messages.
    guard : str
        The guard's name; makes keys this run's own, too.
    patience_s : float
        How long one waits for a worker when there is none.
    """

    def __init__(
        self,
        client: Client,
        name: str,
        guard: str,
        function: Callable[[J], R],
        jobs: Iterator[J],
        lost: Callable[[J, str], R],
        patience_s: float,
        say: Callable[[str], None],
    ) -> None:
        self.client = client
        self.name = name
        self.guard = guard
        self.function = function
        self.jobs = jobs
        self.quarantined: deque[J] = deque()
        """Jobs that were on a worker that died."""
        self.lost = lost
        self.patience_s = patience_s
        self.say = say
        self.flying: dict[Future, InFlight[J]] = {}
        self.landed: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self.numbers = count(1)
        self.carry = carrier()
        self.workers: dict[str, int] = {}
        """Threads by worker, as they were at ``looked``."""
        self.looked = 0.0
        self.idle_since: float | None = None
        """Since when there has been no worker."""

    def results(self) -> Iterator[R]:
        """Yield results as jobs finish, until nothing is left to do.

        Raises
        ------
        ClusterLost
            If the connection to the scheduler broke, or there was no worker for longer than one waits.
        ConfigError
            If a worker is not fit for the work.
        """
        while True:
            self._look()
            self._send()
            if not (self.flying or self.quarantined):
                return
            for future in self._landed():
                yield from self._outcome(future, self.flying.pop(future))
                future.release()

    def _send(self) -> None:
        apart = {flight.alone for flight in self.flying.values() if flight.alone}
        if not apart:
            # Twice the threads keeps every worker busy while constant memory holds the rest back.
            room = max(2, 2 * sum(self.workers.values())) - len(self.flying)
            for job in islice(self.jobs, max(0, room)):
                self._fly(InFlight(job))
        if len(self.flying) == len(apart):
            for address in [address for address in self.workers if address not in apart]:
                if self.quarantined:
                    self._fly(InFlight(self.quarantined.popleft(), address))

    def _fly(self, flight: InFlight[J]) -> None:
        name = getattr(flight.job, "key", self.function.__name__.strip("_"))
        # Numbered: a key that failed must not come back. Not pure: the store knows what is done already.
        future = self.client.submit(
            self.carry,
            dumps((work, self.function, flight.job)),
            self.guard,
            key=f"{name}-{self.guard}-{next(self.numbers)}",
            pure=False,
            workers=[flight.alone] if flight.alone else None,
        )
        self.flying[future] = flight
        future.add_done_callback(self.landed.put)

    def _landed(self) -> list[Future]:
        try:
            found = [self.landed.get(timeout=TICK_S)]
        except queue.Empty:
            return []
        while not self.landed.empty():
            found.append(self.landed.get())
        return [future for future in found if future in self.flying]

    def _look(self) -> None:
        """See, but not more often than every second, who is there."""
        if self.workers and time.monotonic() < self.looked + TICK_S:
            return
        if self.client.status != "running":
            # Asked now, it would not answer for long.
            raise self._gone()
        try:
            self.workers = self.client.nthreads()
        except OSError as error:
            raise self._gone() from error
        self.looked = time.monotonic()
        self._wait_for_workers()
        for future, flight in list(self.flying.items()):
            if flight.alone and flight.alone not in self.workers and not future.done():
                # Its worker went before it got there.
                self.quarantined.append(self.flying.pop(future).job)
                future.release()

    def _wait_for_workers(self) -> None:
        if self.workers:
            self.idle_since = None
        elif self.idle_since is None:
            self.idle_since = self.looked
            self.say(f"no worker is left; waiting up to {self.patience_s:g} s for one")
        elif self.looked > self.idle_since + self.patience_s:
            raise ClusterLost(f"no worker was left for {self.patience_s:g} s")

    def _outcome(self, future: Future, flight: InFlight[J]) -> Iterator[R]:
        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            yield from self._died(flight, error)
        elif isinstance(error, NoWorkerError | NoValidWorkerError):
            # A scheduler may be set to give up what waits for workers; patience is this side's.
            if flight.alone:
                self.quarantined.append(flight.job)
            else:
                self._fly(flight)
        elif future.status == "error":
            future.result()
        elif future.status == "finished":
            yield from self._fetched(future, flight)
        elif self.client.status == "running":
            # Cancelled by a scheduler that is there: the worker died with the result before it was fetched.
            self.quarantined.append(flight.job)
        else:
            raise self._gone()

    def _fetched(self, future: Future, flight: InFlight[J]) -> Iterator[R]:
        try:
            fault, result = future.result()
        except KilledWorker as error:
            # The worker died between doing the job and handing over the result.
            yield from self._died(flight, error)
        except (CancelledError, OSError) as error:
            if self.client.status != "running":
                raise self._gone() from error
            self.quarantined.append(flight.job)
        else:
            if fault:
                raise ConfigError(fault)
            yield result

    def _died(self, flight: InFlight[J], error: KilledWorker) -> Iterator[R]:
        if flight.alone:
            yield self.lost(flight.job, self._why(error))
        else:
            self.quarantined.append(flight.job)

    def _gone(self) -> ClusterLost:
        return ClusterLost(f"{self.name} is gone")

    def _why(self, error: KilledWorker) -> str:
        worker = error.last_worker
        for _, event in self.client.get_events("worker-restart-memory") or ():
            if event["worker"] == worker.address:
                used, limit = format_bytes(event["rss"]), format_bytes(worker.memory_limit)
                return (
                    f"the worker process died 2 times here, at last for memory: it used {used} and may use "
                    f"{limit}; give each more (cluster: memory, fewer --workers)"
                )
        return "the worker process died 2 times here; too little memory is the usual cause"
