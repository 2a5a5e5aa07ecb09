"""A SLURM cluster of this machine alone, on loopback, started and stopped by a test."""

import contextlib
import getpass
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.dask_processes import until

CONFIGURATION = """
ClusterName=test
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
MpiDefault=none
ReturnToService=2
KillWait=2
NodeName=localhost CPUs=4 RealMemory=16000
PartitionName=batch Nodes=localhost Default=YES
"""
"""Jobs need nothing that a container lacks: no control groups, no accounting. The node has four cores,
whatever the machine has."""
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol", "sinfo")


@contextlib.contextmanager
def slurm_daemons() -> Iterator[Path]:
    """Run a SLURM cluster meanwhile; yield its configuration file, the value of SLURM_CONF."""
    missing = [program for program in PROGRAMS if shutil.which(program) is None]
    if missing:
        pytest.skip(f"SLURM is not installed (no {missing[0]}): apt-get install slurm-wlm munge")
    # The path of a socket has at most 107 characters.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        # munged refuses a socket that others cannot reach.
        folder.chmod(0o755)
        for name in ("state", "spool"):
            (folder / name).mkdir()
        conf, key = folder / "slurm.conf", folder / "munge.key"
        controller_port, node_port = _free_ports(2)
        conf.write_text(
            CONFIGURATION.format(
                folder=folder, user=getpass.getuser(), controller_port=controller_port, node_port=node_port
            )
        )
        key.touch(0o600)
        key.write_bytes(secrets.token_bytes(32))
        munged = [
            f"--{name}={folder}/munge.{name}" for name in ("socket", "pid-file", "log-file", "seed-file")
        ]
        _start(stack, folder, "munged", "--foreground", f"--key-file={key}", *munged)
        until((folder / "munge.socket").exists, 30)
        _start(stack, folder, "slurmctld", "-D", "-f", conf)
        _start(stack, folder, "slurmd", "-D", "-N", "localhost", "-f", conf)
        environment = os.environ | {"SLURM_CONF": str(conf)}
        until(lambda: "idle" in _output(["sinfo", "--noheader", "--format=%T"], environment), 60)
        yield conf
        subprocess.run(["scancel", "--me"], env=environment, check=True)
        until(lambda: not _output(["squeue", "--noheader"], environment), 60)


def _free_ports(number: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for opened in sockets:
            opened.bind(("127.0.0.1", 0))
        return [opened.getsockname()[1] for opened in sockets]


def _start(stack: contextlib.ExitStack, folder: Path, *words: object) -> None:
    """Start a daemon, which ends with the stack."""
    with (folder / f"{words[0]}.output").open("w") as output:
        process = subprocess.Popen([*map(str, words)], stdout=output, stderr=output, start_new_session=True)
    stack.callback(_stop, process)


def _stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _output(words: list[str], environment: dict[str, str]) -> str:
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    # The controller may not answer yet.
    time.sleep(0.2)
    return done.stdout
