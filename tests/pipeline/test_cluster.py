"""Where tasks run must not matter for what comes out; a dead worker is retried once and then named."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import psutil
import pytest

from scanloom.pipeline import cluster
from scanloom.pipeline.plan import Request
from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import InvalidInput, ScanloomError, UsageError
from tests.pipeline.reading import contents, record
from tests.pipeline.toys.clusters import threads
from tests.pipeline.toys.products import Summary
from tests.pipeline.toys.workflow import NODES, log, request

A, B = range(30), range(10, 35)


def children() -> list[psutil.Process]:
    return [p for p in psutil.Process().children(recursive=True) if "forkserver" not in " ".join(p.cmdline())]


def test_one_and_two_workers_give_the_bytes_of_none(tmp_path):
    asked = request(log(tmp_path, "a", A), log(tmp_path, "b", B), settings={"join": {"spacing": 100}})
    stores = {name: Store(tmp_path / name) for name in ("none", "one", "two")}
    run(asked, stores["none"], cluster="none")
    one = run(asked, stores["one"], cluster="local", workers=1)
    two = run(asked, stores["two"], cluster="local", workers=2)
    assert one.executed == two.executed == 24
    assert contents(stores["none"]) == contents(stores["one"]) == contents(stores["two"])
    assert 50 < two.tasks[0].peak_rss_mb < two.peak_rss_mb < 2000
    assert all(task.wall_s > 0 for task in two.tasks)


def test_a_dead_worker_is_retried_once_and_then_named(tmp_path, store):
    sessions = [
        log(tmp_path, "a", A),
        log(tmp_path, "dies_once", A, "once"),
        log(tmp_path, "dies", A, "deadly"),
        log(tmp_path, "bad", A, "broken"),
    ]
    result = run(request(*sessions), store, cluster="local", workers=2)
    assert record(result, "read", session="dies_once").verdict == "RUN"
    failures = {task.coordinate["session"]: task.error for task in result.failures}
    assert set(failures) == {"dies", "bad"}
    assert isinstance(failures["bad"], InvalidInput)
    assert str(failures["dies"]).startswith("read session=dies: the worker died twice over it")
    assert result.parts(Summary)[0].sessions == ("a", "dies_once")
    assert (tmp_path / "dies" / "deaths").read_text() == "xx"


def test_workers_are_gone_afterwards_and_have_one_thread(tmp_path, store):
    run(request(log(tmp_path, "a", A)), store, cluster="local", workers=1)
    assert [
        p
        for p in children()
        if p.status() != psutil.STATUS_ZOMBIE and "resource_tracker" not in str(p.cmdline())
    ] == []
    assert os.environ["OMP_NUM_THREADS"] == "1"


def test_a_running_scheduler_and_a_factory_serve_as_well(tmp_path):
    asked = request(log(tmp_path, "a", A))
    by_address, by_factory, plain = (Store(tmp_path / name) for name in ("address", "factory", "plain"))
    run(asked, plain, cluster="none")
    with threads() as started:
        assert run(asked, by_address, cluster=started.scheduler_address).executed == 13
    assert run(asked, by_factory, cluster="tests.pipeline.toys.clusters:threads").executed == 13
    assert contents(by_address) == contents(by_factory) == contents(plain)


def test_resources_go_to_workers_that_offer_them(tmp_path, store):
    nodes = tuple(dataclasses.replace(n, resources=(("GPU", 1.0),)) if n.name == "join" else n for n in NODES)
    asked = Request(nodes, (log(tmp_path, "a", A),))
    with pytest.raises(UsageError, match="join: no worker offers GPU 1"):
        run(asked, store, cluster="none")
    assert run(asked, store, cluster="tests.pipeline.toys.clusters:threads").executed > 0
    impossible = tuple(
        dataclasses.replace(n, resources=(("GPU", 8.0),)) if n.name == "read" else n for n in NODES
    )
    asked = Request(impossible, (log(tmp_path, "b", B),))
    with pytest.raises(UsageError, match="read session=b: no worker offers GPU 8"):
        run(asked, store, cluster="tests.pipeline.toys.clusters:threads")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lokal", "cluster 'lokal' is unknown"),
        ("no.such.module:factory", "cluster factory cannot be imported"),
        ("tests.pipeline.toys.clusters:nothing", "cluster factory cannot be imported"),
    ],
)
def test_clusters_that_do_not_exist_are_usage_errors(tmp_path, store, name, message):
    with pytest.raises(UsageError, match=message):
        run(request(log(tmp_path, "a", A)), store, cluster=name)


def test_no_workers_is_a_usage_error(tmp_path, store):
    with pytest.raises(UsageError, match="0 workers cannot do anything"):
        run(request(log(tmp_path, "a", A)), store, workers=0)


def test_a_cluster_without_workers_fails_instead_of_waiting(tmp_path, store, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr(cluster, "WORKERS_WITHIN_S", 0.2)
    empty = LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0", silence_logs=50)
    with empty, pytest.raises(UsageError, match="the cluster has no worker after"):
        run(request(log(tmp_path, "a", A)), store, cluster=empty.scheduler_address)


def test_a_cluster_that_loses_its_workers_fails_instead_of_waiting(tmp_path, store, monkeypatch):
    monkeypatch.setattr(cluster, "WORKERS_WITHIN_S", 0.5)
    with threads() as started:
        executor = cluster.executor(started.scheduler_address, None)
        started.scale(0)
        with pytest.raises(ScanloomError, match="the cluster has had no worker"):  # noqa: PT012
            while True:
                executor.next(0.1)
        executor.close()


def test_a_cluster_that_does_not_stop_in_time_costs_no_result(tmp_path, store, monkeypatch):
    """On a machine with too much to do closing takes longer than anybody waits."""
    from distributed import Client

    closed = []

    def late(client, timeout=None):
        if timeout is None:  # a client of an earlier test, met by the garbage collector
            return close(client)
        closed.append(timeout)
        close(client, timeout)
        raise TimeoutError

    close = Client.close
    monkeypatch.setattr(Client, "close", late)
    assert run(request(log(tmp_path, "a", A)), store, cluster="tests.pipeline.toys.clusters:threads").executed
    assert closed == [cluster.CLOSED_WITHIN_S]


def test_nothing_listens_beyond_this_machine():
    executor = cluster.executor("local", 1)
    try:
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = {c.laddr.ip for p in family for c in p.net_connections("inet") if c.status == "LISTEN"}
    finally:
        executor.close()
    assert listening == {"127.0.0.1"}


def test_dask_is_not_imported_before_it_is_needed():
    """The command line must answer at once."""
    code = "import sys, scanloom.pipeline.run; print(sorted({'dask', 'distributed', 'rich', 'pandas'} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"
