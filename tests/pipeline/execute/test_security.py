"""Who may connect to scheduler and workers, and the addresses and certificates of running schedulers."""

import os
import subprocess
import sys
from urllib.error import HTTPError
from urllib.request import urlopen

import cloudpickle
import dask
import pytest

from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor
from flexroad.pipeline.execute.clusters import open_cluster
from flexroad.pipeline.execute.dask import check_address

# Workers cannot import this test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def lost(job, why):
    return (job, why)


def double(job):
    return 2 * job


@pytest.mark.parametrize("address", ["localhost:8786", "tcp://10.1.2.3:8786", "tls://[::1]:9", "wss://a.b:1"])
def test_check_address_of_scheduler_is_accepted(address):
    check_address(address)


@pytest.mark.parametrize(
    "address", ["", "foo", "tcp://foo", "tcp://", "http://foo:1", "foo:bar", ":8786", "a b:1"]
)
def test_check_address_other_text_raises(address):
    with pytest.raises(
        ConfigError, match="is no address of a Dask scheduler; give its host and port, as tcp:"
    ):
        check_address(address)


def test_run_executor_without_port_is_refused_before_the_catalog_is_read(flexroad, tmp_path):
    words = ["run", "--catalog", tmp_path / "none.parquet", "--out", tmp_path / "run", "--executor", "foo"]
    assert "'foo' is no address of a Dask scheduler" in flexroad(*words).expected(2).err


@pytest.mark.slow
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "127.0.0.1:1", "ws://127.0.0.1:1"])
def test_scheduler_without_tls_is_said_to_be_open(address):
    said: list[str] = []
    with open_cluster(Cluster(), None, address, False, notify=said.append):
        assert said == [
            "a scheduler without tls:// is open to everyone who reaches it, and runs programs as its user"
        ]


def test_map_scheduler_with_tls_takes_the_certificates_of_dask(tmp_path):
    with open_cluster(Cluster(workers=1), None, None, False) as target:
        address, security = target.target.scheduler_address, target.target.security
        executor = DaskExecutor(scheduler=address)
        with pytest.raises(
            ConfigError, match=f"^{address}: Dask has no certificates for it; set distributed"
        ):
            list(executor.map(double, [1], lost))
        (tmp_path / "ca").write_text(security.tls_ca_file)
        (tmp_path / "key").write_text(security.tls_client_key)
        names = {
            "distributed.comm.tls.ca-file": str(tmp_path / "ca"),
            "distributed.comm.tls.client.cert": str(tmp_path / "ca"),
            "distributed.comm.tls.client.key": str(tmp_path / "key"),
        }
        with dask.config.set(names):
            assert list(executor.map(double, [1, 2], lost)) == [2, 4]
            (tmp_path / "key").unlink()
            with pytest.raises(ConfigError, match="cannot load the certificates of Dask's configuration"):
                list(executor.map(double, [1], lost))


OTHER_USER = """
import asyncio, os, sys
from distributed.core import rpc
from distributed.security import Security

own = Security.temporary().get_connection_args("client")
os.setgid(65534)
os.setuid(65534)

async def ask(address, arguments):
    async with rpc(address, connection_args=arguments, timeout=5) as server:
        try:
            await server.identity()
            print(address)
        except (OSError, ValueError):
            pass

for address in sys.argv[1:]:
    place = address.partition("://")[2]
    asyncio.run(ask("tls://" + place, own))
    asyncio.run(ask("tcp://" + place, {}))
"""
"""Prints the addresses that answer another user, with certificates of their own or without."""


@pytest.mark.slow
@pytest.mark.skipif(os.getuid() != 0, reason="only root can start a process of another user")
@pytest.mark.parametrize("security", ["tls", "none"])
def test_local_cluster_answers_other_users_only_without_tls(security):
    from distributed import Client

    with (
        open_cluster(Cluster(workers=1, security=security), None, None, False) as target,
        Client(target.target, set_as_default=False) as client,
    ):
        ((worker, values),) = client.scheduler_info(n_workers=-1)["workers"].items()
        addresses = [target.target.scheduler_address, worker, values["nanny"]]
        assert all(address.partition("://")[2].startswith("127.0.0.1:") for address in addresses)
        command = [sys.executable, "-c", OTHER_USER, *addresses]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        answered = done.stdout.split()
        assert set(answered) == (set() if security == "tls" else set(addresses))
        # The pages of Dask's web server show logs to everyone.
        for port in (target.target.scheduler.http_server.port, values["services"]["dashboard"]):
            for page in ("info/main/workers.html", "json/counts.json", "metrics", "health"):
                with pytest.raises(HTTPError, match="404"):
                    urlopen(f"http://127.0.0.1:{port}/{page}", timeout=10)
