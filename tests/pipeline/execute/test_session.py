"""Waiting for workers, with a client and a clock of the test's own."""

import pytest

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ClusterLost
from flexroad.pipeline.execute import session as module
from flexroad.pipeline.execute.session import Session


class Client:
    """A client of a scheduler that lists the workers of the test."""

    status = "running"

    def __init__(self):
        self.workers = {}

    def nthreads(self):
        return self.workers


@pytest.fixture
def session(monkeypatch):
    monkeypatch.setattr(module.time, "monotonic", lambda: session.now)
    session = Session(Client(), "", "", repr, iter([]), repr, Cluster(patience_s=20), lambda line: None)
    session.now = 1000.0
    return session


def check_after(session, seconds, times=1):
    for _ in range(times):
        session.now += seconds
        session._check_cluster()


def test_check_without_workers_for_longer_than_the_patience_raises(session):
    check_after(session, 1, times=20)
    with pytest.raises(ClusterLost, match="for 20 s"):
        check_after(session, 1, times=3)


def test_check_after_a_suspension_waits_on(session):
    check_after(session, 0)
    check_after(session, 3600)
    check_after(session, 1)
    session.client.workers = {"tcp://127.0.0.1:1": 1}
    check_after(session, 3600)
    session.client.workers = {}
    check_after(session, 1, times=20)
    with pytest.raises(ClusterLost, match="for 20 s"):
        check_after(session, 1, times=3)
