"""What a scheduler gets to see of a run; it need not have flexroad, for all of it travels by value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import SchedulerPlugin


def carrier() -> Callable[[bytes, str], tuple[str, Any]]:
    """Return what a task is: a packed call that only a worker opens, and only if it is fit to.

    It gives why the job must not be done there, or nothing, and what the job came to. A scheduler opens the
    tasks it is given; packed, a tile costs it no more than its bytes.
    """

    def carry(packed: bytes, guard: str) -> tuple[str, Any]:
        from distributed import get_worker
        from distributed.protocol.pickle import loads

        worker = get_worker()
        if guard not in worker.plugins:
            return f"worker {worker.address} cannot load flexroad; install it there", None
        fault: str = worker.plugins[guard].fault
        if fault:
            return fault, None
        work, function, job = loads(packed)
        return "", work(function, job)

    return carry


def no_second_try(client_id: str, guard: str) -> SchedulerPlugin:
    """Return a plugin that hands a client its own tasks back as soon as their worker dies.

    A scheduler tries such tasks again on other workers, as often as it is set to
    (``distributed.scheduler.allowed-failures``), and so a tile that kills its worker would take others with
    it. Nothing changes for other clients, and nothing stays when the client goes, be it killed.
    """

    class NoSecondTry(SchedulerPlugin):  # type: ignore[misc]
        def update_graph(self, scheduler: Any, *, client: str, tasks: list[Any], **_: Any) -> None:
            if client == client_id:
                for key in tasks:
                    # One death more is more than allowed.
                    scheduler.tasks[key].suspicious = scheduler.allowed_failures

        def remove_client(self, scheduler: Any, client: str) -> None:
            if client == client_id:
                scheduler.worker_plugins.pop(guard, None)
                scheduler.plugins.pop(f"flexroad-{guard}", None)

    return NoSecondTry()
