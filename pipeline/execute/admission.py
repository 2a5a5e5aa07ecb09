"""Which workers may do jobs: those whose proof was accepted; the others are left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from flexroad.pipeline.execute.executor import Probe
from flexroad.pipeline.execute.workers import reason_of


class Admission:
    """Accepts the proofs of workers, and tells which workers are left out.

    Parameters
    ----------
    probe : Probe, optional
        The probe of the `WorkerCheck`.
    say : callable
        Prints one line for the user.
    """

    def __init__(self, probe: Probe | None, say: Callable[[str], None]) -> None:
        self.probe = probe
        self.say = say
        self.left_out: dict[str, str] = {}
        """Why a worker gets no jobs, in one line, by its address."""
        self._accepted: dict[str, Any] = {}
        """Accepted proofs by worker address."""
        self._told: set[tuple[str, str]] = set()
        """Host and reason of the workers left out: one line for all workers of a host."""

    def able(self, present: Mapping[str, int]) -> dict[str, int]:
        """Return those of the workers that are present, by address, that are not left out."""
        # The address of a worker that has ended may be that of another one later.
        self._accepted = {address: proof for address, proof in self._accepted.items() if address in present}
        self.left_out = {address: line for address, line in self.left_out.items() if address in present}
        return {address: n for address, n in present.items() if address not in self.left_out}

    def accepts(self, address: str, host: str, fault: str, proof: Any) -> bool:
        """Return whether a worker may do jobs, by what `WorkerCheck.admit` returned; else leave it out."""
        if address in self.left_out:
            # Its other jobs bring the same fault or proof.
            return False
        if self.probe and proof is not None and self._accepted.get(address) != proof:
            try:
                self.probe.accept(proof)
                self._accepted[address] = proof
            except OSError as error:
                fault = reason_of(error)
        if fault:
            self.left_out[address] = f"worker {address} on {host} is left out: {fault}"
            if (host, fault) not in self._told:
                self._told.add((host, fault))
                self.say(self.left_out[address])
        return not fault
