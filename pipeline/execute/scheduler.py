"""What a scheduler is asked for while a run lasts, whatever else it is set to and whoever else uses it."""

from __future__ import annotations

from typing import Any

from distributed import SchedulerPlugin


def no_second_try(client_id: str, guard: str) -> SchedulerPlugin:
    """Return a plugin that hands a client its own tasks back as soon as their worker dies.

    A scheduler tries such tasks again on other workers, as often as it is set to
    (``distributed.scheduler.allowed-failures``), and so a tile that kills its worker would take others with
    it. Nothing changes for other clients, and nothing stays when the client goes, be it killed.
    """

    # A class of its own each time travels whole: schedulers need not have flexroad.
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
