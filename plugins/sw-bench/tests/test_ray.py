"""Sweeps on a Ray cluster of two nodes on this machine; they need Ray, which is heavy: `make test-ray` installs it."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from sw_bench.ray_cluster import LOST, RayExecutor, RayOptions, status_of
from sw_bench.ray_work import work

from splatwizard_core.api import UserInputError

if sys.platform != "linux":
    pytest.skip("its cluster is for Linux", allow_module_level=True)

HERE = Path(__file__).parent
SLOW_COUNT = """
import sys, time
from pathlib import Path
done = Path(sys.argv[1])
for i in range(int(done.read_text()) if done.exists() else 0, 40):
    time.sleep(0.1)
    done.write_text(str(i + 1))
print("counted")
"""


@dataclass
class Site:
    out: Path
    device: str = "cpu"


@pytest.fixture
def cluster(monkeypatch):
    """Two nodes with one core each."""
    pytest.importorskip("ray", reason="Ray is not installed: make test-ray")
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    size = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={**size, "num_cpus": 0})
    nodes = [cluster.add_node(**size), cluster.add_node(**size)]
    cluster.wait_for_nodes()
    yield cluster, nodes
    with contextlib.suppress(Exception):
        ray.shutdown()
    cluster.shutdown()


def ended(executor, count):
    """Ends of so many processes."""
    found = []
    while len(found) < count:
        found += executor.ended(0.5)
    return sorted(found)


def test_without_ray_the_package_to_install_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserInputError, match=r"pip install 'sw-bench\[ray\]'"):
        RayExecutor(RayOptions(), Site(tmp_path))


def named(name, base=Exception, **facts):
    """An exception of a class of this name, as Ray has them."""
    return type(name, (base,), facts)("this  is\nsaid")


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (named("WorkerCrashedError"), LOST, ""),
        (named("OwnerDiedError", type("ObjectLostError", (Exception,), {})), LOST, ""),
        (named("OutOfMemoryError"), -9, ""),
        (named("RuntimeEnvSetupError"), 1, "RuntimeEnvSetupError: this is said"),
        (named("RayTaskError", cause=FileNotFoundError("no python")), 1, "FileNotFoundError: no python"),
    ],
)
def test_only_what_takes_a_worker_with_it_is_a_loss(error, status, reason):
    assert status_of(error) == (status, reason)


def test_a_process_gets_the_directory_and_the_variables_of_the_sweep(tmp_path):
    program = "import os; print(os.getcwd(), os.environ['SPLATWIZARD_TEST'])"
    status, _ = work([sys.executable, "-c", program], str(tmp_path / "log"), str(tmp_path), {"SPLATWIZARD_TEST": "x"})
    assert status == 0
    assert (tmp_path / "log").read_text() == f"{tmp_path.resolve()} x\n"


def test_a_process_needs_whole_gpus_and_the_memory_of_a_node():
    with pytest.raises(ValueError, match="a part of one GPU, or a whole number"):
        RayOptions(gpus=1.5)
    executor = object.__new__(RayExecutor)
    executor._options = RayOptions(cores=1, gpus=0.5, memory_gb=2)
    node = {"CPU": 8.0, "GPU": 2.0, "memory": 7e9}
    assert executor._places(node) == 3
    assert executor._places({**node, "memory": 1e9}) == 0


@pytest.mark.slow
def test_what_a_node_takes_with_it_is_started_again_and_nothing_is_lost(cluster, tmp_path):
    """Two processes on two nodes, of which one is killed: it is told as lost, and started again it goes on."""
    made, nodes = cluster
    executor = RayExecutor(RayOptions(address=made.address, cores=1), Site(tmp_path))
    assert executor.slots == 2
    program = tmp_path / "count.py"
    program.write_text(SLOW_COUNT)
    commands = {name: [sys.executable, str(program), str(tmp_path / name)] for name in "ab"}
    for name, command in commands.items():
        executor.start(name, command, tmp_path / f"{name}.log")
    while not all((tmp_path / name).exists() and int((tmp_path / name).read_text() or 0) > 2 for name in "ab"):
        time.sleep(0.1)
    made.remove_node(nodes[0], allow_graceful=False)
    first = ended(executor, 2)
    assert sorted(status for _, status, _ in first) == [LOST, 0]
    (lost,) = [ticket for ticket, status, _ in first if status == LOST]
    until = time.monotonic() + 60
    while executor.slots == 2 and time.monotonic() < until:  # Ray asks its nodes for signs of life from time to time
        time.sleep(0.5)
    assert executor.slots == 1
    executor.start(lost, commands[lost], tmp_path / f"{lost}.log")
    assert [(ticket, status) for ticket, status, _ in ended(executor, 1)] == [(lost, 0)]
    assert [(tmp_path / name).read_text() for name in "ab"] == ["40", "40"]
    executor.stop()


@pytest.mark.slow
def test_a_sweep_survives_the_loss_of_a_node(cluster, tmp_path):
    """The table of a sweep whose node was killed half way is that of one that nobody disturbed."""
    pytest.importorskip("sw_3dgs", reason="the sweep needs a method")
    import subprocess
    import threading

    made, nodes = cluster

    def sweep(out, *options):
        words = ["bench", "--method", "3dgs", "--scene", "demo:tiny", "--rate", "r1", "--seed", "0,1,2", "--out", out]
        words += ["--set", "iterations=150", "--set", "checkpoint_every=10", "--device", "cpu", "--json", *options]
        return subprocess.Popen(
            [sys.executable, "-m", "splatwizard_core", *words], stdout=subprocess.PIPE, text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip

    disturbed = sweep(str(tmp_path / "ray"), "--executor", "ray", "-o", f"address={made.address}", "-o", "cores=1")

    def kill_one_when_it_works():
        while not list(tmp_path.glob("ray/seed-*/*/*/*/checkpoints/*.json")) and disturbed.poll() is None:
            time.sleep(0.05)
        made.remove_node(nodes[0], allow_graceful=False)

    killer = threading.Thread(target=kill_one_when_it_works)
    killer.start()
    rows = [json.loads(disturbed.communicate(timeout=500)[0])["runs"]]
    killer.join()
    assert disturbed.returncode == 0
    import sqlite3

    with contextlib.closing(sqlite3.connect(tmp_path / "ray" / "bench.sqlite")) as index:
        assert max(attempts for (attempts,) in index.execute("SELECT attempts FROM runs")) == 2
    quiet = sweep(str(tmp_path / "quiet"))
    rows.append(json.loads(quiet.communicate(timeout=500)[0])["runs"])
    for row in (each for table in rows for each in table):
        del row["directories"]
    assert rows[0] == rows[1]
