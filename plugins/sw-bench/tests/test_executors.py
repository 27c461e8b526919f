"""Executors with real processes that end in different ways, and the process that ends with its owner."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from sw_bench import local
from sw_bench.executor import LOST, Site
from sw_bench.local import LocalExecutor, LocalOptions

from splatwizard_core import __version__
from splatwizard_core.api import UserInputError

WAITS = "import sys; print('began', flush=True); sys.stdin.read(); print('told to end')"


def python(program: str) -> list[str]:
    return [sys.executable, "-c", program]


def ended(executor, count):
    """Ends of so many processes, by ticket."""
    found = []
    while len(found) < count:
        found += executor.ended(0.2)
    return {ticket: status for ticket, status, _ in found}


def wait_for(path: Path, text: str) -> None:
    while not (path.exists() and text in path.read_text()):
        time.sleep(0.02)


@pytest.fixture
def four_cores(monkeypatch):
    monkeypatch.setattr(local, "available_cores", lambda: 4)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)


def test_processes_of_this_machine_tell_how_they_ended(tmp_path, four_cores):
    executor = LocalExecutor(LocalOptions(workers=2), Site(tmp_path, "cpu"))
    log = tmp_path / "log"
    executor.start("well", python("import os; print(os.environ['OMP_NUM_THREADS'], 'threads')"), log)
    executor.start("killed", python("import os; os.kill(os.getpid(), 9)"), log)
    assert ended(executor, 2) == {"well": 0, "killed": -9}
    assert log.read_text() == "2 threads\n"
    executor.start("badly", python("import sys; sys.exit('error: why')"), log)
    assert ended(executor, 1) == {"badly": 1}
    assert log.read_text() == "2 threads\nerror: why\n"


def test_who_waits_for_processes_does_not_look_again_and_again(tmp_path, monkeypatch, four_cores):
    executor = LocalExecutor(LocalOptions(workers=1), Site(tmp_path, "cpu"))
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail("waits by sleeping"))
    assert executor.ended(0.0) == []
    executor.start("a", python(""), tmp_path / "log")
    assert executor.ended(300.0) == [("a", 0, "")]


def test_stopping_lets_processes_end_by_themselves(tmp_path, four_cores):
    executor = LocalExecutor(LocalOptions(), Site(tmp_path, "cpu"))
    executor.start("a", python(WAITS), tmp_path / "log")
    wait_for(tmp_path / "log", "began")
    assert executor.ended(0.0) == []
    executor.stop()
    assert (tmp_path / "log").read_text() == "began\ntold to end\n"
    assert executor.ended(0.0) == []


@pytest.mark.parametrize(
    ("options", "gpus", "slots", "threads"),
    [({}, [], 1, 4), ({"workers": 3}, [], 3, 1), ({}, ["0", "3"], 2, 2), ({"per_gpu": 3}, ["0"], 3, 1)],
)
def test_cores_and_gpus_are_shared_out(tmp_path, monkeypatch, four_cores, options, gpus, slots, threads):
    monkeypatch.setattr(local, "visible_gpus", lambda: gpus)
    executor = LocalExecutor(LocalOptions(**options), Site(tmp_path, "cuda" if gpus else "cpu"))
    assert (executor.slots, executor.threads) == (slots, threads)


def test_each_process_sees_its_gpu_alone(tmp_path, monkeypatch, four_cores):
    monkeypatch.setattr(local, "visible_gpus", lambda: ["5", "7"])
    executor = LocalExecutor(LocalOptions(), Site(tmp_path, "cuda"))
    for name in "ab":
        executor.start(name, python("import os; print(os.environ['CUDA_VISIBLE_DEVICES'])"), tmp_path / name)
    assert ended(executor, 2) == {"a": 0, "b": 0}
    assert sorted((tmp_path / name).read_text() for name in "ab") == ["5\n", "7\n"]


def test_more_processes_than_cores_are_refused(tmp_path, four_cores):
    with pytest.raises(UserInputError, match="workers = 5: this machine has 4 cores"):
        LocalExecutor(LocalOptions(workers=5), Site(tmp_path, "cpu"))


def test_fewer_threads_than_a_share_may_be_asked_for(tmp_path, monkeypatch, four_cores):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert local.environment(4, "")["OMP_NUM_THREADS"] == "1"
    monkeypatch.setenv("OMP_NUM_THREADS", "16")
    assert local.environment(4, "")["OMP_NUM_THREADS"] == "4"


def test_a_process_of_a_sweep_is_sw_and_waits_for_who_holds_its_directory(tmp_path):
    """`--version` in place of a run; the lock of the directory is held for a moment by this process."""
    from splatwizard_core.tooling import directory_lock

    command = [sys.executable, "-m", "sw_bench.child", str(tmp_path / "run"), "--", "--version"]
    with directory_lock(tmp_path / "run"):
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stderr is not None
        assert b"waiting: " in process.stderr.readline()
        assert process.poll() is None
    assert process.stdout is not None
    assert process.stdout.read().split() == [__version__.encode()]  # its input stays open meanwhile: its owner is there
    assert process.wait() == 0


def test_a_process_ends_with_its_owner_as_with_ctrl_c(tmp_path):
    """The owner is killed; the process gets SIGTERM, which a training takes for Ctrl-C, and no signal of its group."""
    program = textwrap.dedent(f"""
        import os, signal, sys, threading, time
        from sw_bench.child import _end_with
        def end(*_):
            open({str(tmp_path / "ended")!r}, "w").write("SIGTERM")
            os._exit(0)
        signal.signal(signal.SIGTERM, end)
        threading.Thread(target=_end_with, args=(0,), daemon=True).start()
        open({str(tmp_path / "began")!r}, "w").write("began")
        time.sleep(3600)
    """)
    owner = textwrap.dedent(f"""
        import subprocess, sys, time
        subprocess.Popen([sys.executable, "-c", {program!r}], stdin=subprocess.PIPE, start_new_session=True)
        time.sleep(3600)
    """)
    process = subprocess.Popen(python(owner), env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    wait_for(tmp_path / "began", "began")
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_for(tmp_path / "ended", "SIGTERM")


def slurm(tmp_path, **options):
    pytest.importorskip("submitit", reason="pip install 'sw-bench[slurm]'")
    from sw_bench.slurm import SlurmExecutor, SlurmOptions

    return SlurmExecutor(SlurmOptions(**options), Site(tmp_path, "auto"))


def test_slurm_without_submitit_or_a_cluster_is_told(tmp_path, monkeypatch):
    from sw_bench.slurm import SlurmExecutor, SlurmOptions

    monkeypatch.setattr("shutil.which", lambda name: None)
    if "submitit" in sys.modules or __import__("importlib.util").util.find_spec("submitit"):
        with pytest.raises(UserInputError, match="there is no sbatch here"):
            SlurmExecutor(SlurmOptions(), Site(tmp_path, "cpu"))
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(UserInputError, match=r"pip install 'sw-bench\[slurm\]'"):
        SlurmExecutor(SlurmOptions(), Site(tmp_path, "cpu"))


@pytest.mark.parametrize("cluster", ["debug", "local"])
def test_jobs_of_submitit_tell_how_they_ended(tmp_path, cluster):
    executor = slurm(tmp_path, cluster=cluster)
    executor.start("well", python("print('done')"), tmp_path / "log")
    executor.start("badly", python("import sys; sys.exit(3)"), tmp_path / "log")
    assert ended(executor, 2) == {"well": 0, "badly": 3}
    assert (tmp_path / "log").read_text() == "done\n"
    executor.stop()


@pytest.mark.slow
def test_a_job_whose_process_is_gone_is_lost(tmp_path):
    executor = slurm(tmp_path, cluster="local")
    executor.start("a", python("import os, signal; os.kill(os.getppid(), signal.SIGKILL)"), tmp_path / "log")
    assert ended(executor, 1) == {"a": LOST}
    executor.stop()


def test_stopping_cancels_jobs_which_end_by_themselves(tmp_path):
    executor = slurm(tmp_path, cluster="local")
    executor.start("a", python(WAITS), tmp_path / "log")
    wait_for(tmp_path / "log", "began")
    executor.stop()
    wait_for(tmp_path / "log", "told to end")


def test_a_job_whose_time_is_up_ends_its_process_and_goes_back_into_the_queue(tmp_path):
    submitit = pytest.importorskip("submitit", reason="pip install 'sw-bench[slurm]'")
    import threading

    from sw_bench.slurm import Work

    work = Work(python(WAITS), str(tmp_path / "log"))
    running = threading.Thread(target=work)
    running.start()
    wait_for(tmp_path / "log", "began")
    again = work.checkpoint()
    running.join()
    assert (tmp_path / "log").read_text() == "began\ntold to end\n"
    assert isinstance(again, submitit.helpers.DelayedSubmission)
    assert again.function == Work(work.command, work.log)


def test_a_signal_that_comes_while_a_job_waits_lets_its_process_end_at_once(tmp_path, monkeypatch):
    """As submitit does it: the checkpoint is asked for by a signal handler, in the thread that waits."""
    pytest.importorskip("submitit", reason="pip install 'sw-bench[slurm]'")
    import threading

    from sw_bench import slurm as module

    monkeypatch.setattr(module, "PATIENCE_SECONDS", 300.0)
    work, after = module.Work(python(WAITS), str(tmp_path / "log")), []

    def take_checkpoint(*_):
        work.checkpoint()
        after.append(work._process.returncode)

    def send():
        wait_for(tmp_path / "log", "began")
        os.kill(os.getpid(), signal.SIGUSR2)

    before = signal.signal(signal.SIGUSR2, take_checkpoint)
    try:
        threading.Thread(target=send).start()
        assert work()[0] == 0
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert after == [0]  # it had ended when the checkpoint was done


@pytest.mark.parametrize(
    ("state", "told", "status", "reason"),
    [
        ("NODE_FAIL", "Job has not produced any output", LOST, ""),
        ("PREEMPTED by 5", "Job has not produced any output", LOST, ""),
        ("OUT_OF_MEMORY", "Job has not produced any output", -9, ""),
        ("CANCELLED by 5", "Job has not produced any output", 1, "no result, CANCELLED by 5"),
        ("FAILED", "trace:\n  File x\nOSError: no space left\nsee the log", 1, "OSError: no space left"),
    ],
)
def test_a_job_without_a_result_tells_why(state, told, status, reason):
    from sw_bench.slurm import _status_of

    assert _status_of(RuntimeError(told), state) == (status, reason)


def test_what_fails_on_a_node_is_a_line_of_the_log(tmp_path):
    executor = slurm(tmp_path, cluster="local")
    executor.start("a", ["/nowhere/python"], tmp_path / "log")
    assert ended(executor, 1) == {"a": 1}
    assert re.fullmatch(r"error: job \d+: FileNotFoundError: .*/nowhere/python.*\n", (tmp_path / "log").read_text())
    executor.stop()


def test_jobs_that_a_killed_sweep_left_are_cancelled(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="pip install 'sw-bench[slurm]'")
    from sw_bench import slurm as module

    cancelled = []
    monkeypatch.setattr(module.shutil, "which", lambda name: f"/usr/bin/{name}")
    executor = module.SlurmExecutor(module.SlurmOptions(), Site(tmp_path, "auto"))
    monkeypatch.setattr(executor._executor, "submit", lambda work: type("Job", (), {"job_id": "9"})())
    monkeypatch.setattr(module.subprocess, "run", lambda words, check: cancelled.append(words))
    (tmp_path / ".slurm").mkdir()
    (tmp_path / ".slurm" / "submitted.json").write_text(json.dumps(["5", "7"]))
    executor.start("a", ["true"], tmp_path / "log")
    assert cancelled == [["scancel", "5", "7"]]
    assert json.loads((tmp_path / ".slurm" / "submitted.json").read_text()) == ["9"]
