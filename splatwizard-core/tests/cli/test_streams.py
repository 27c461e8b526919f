"""What a shell does to the streams of a command, and what systems send to end it."""

import errno
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from splatwizard_core.base.interrupt import InterruptGuard
from splatwizard_core.base.progress import track
from splatwizard_core.cli.main import main
from splatwizard_core.cli.streams import ended_like_ctrl_c
from splatwizard_core.coding.container import ContainerWriter

SW = f"{shlex.quote(sys.executable)} -m splatwizard_core"


def in_shell(line: str) -> subprocess.CompletedProcess[str]:
    """A line of bash, with the status of the first command of a pipe."""
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line}"], capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.parametrize(("command", "closed"), [("list-plugins", ">&-"), ("--help", "2>&-"), ("--help", "<&-")])
def test_closed_streams_are_no_error(command: str, closed: str):
    done = in_shell(f"{SW} {command} {closed}")
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("encoding", "command"),
    [("LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0", "info"), ("PYTHONIOENCODING=latin-1", "new-plugin hi --into")],
)
def test_a_name_that_the_terminal_cannot_show_is_escaped(encoding: str, command: str, tmp_path: Path):
    folder = tmp_path / "h\N{GREEK SMALL LETTER ALPHA}"
    assert command != "info" or main(["data", "synth", str(folder), "--size", "tiny"]) == 0
    done = in_shell(f"{encoding} {SW} {command} {shlex.quote(str(folder))}")
    assert done.returncode == 0, done.stderr
    assert "u03b1" in done.stdout or "udcce" in done.stdout


def test_a_terminal_gets_no_orders_from_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    orders = "\x1b[31mred\x07\r\x9b1m\N{RIGHT-TO-LEFT OVERRIDE}"
    writer = ContainerWriter("toy", 1)
    writer.static["note"] = orders
    writer.add("means", b"12345")
    writer.write(tmp_path / "x.swz")
    assert main(["info", str(tmp_path / "x.swz")]) == 0
    assert main(["info", str(tmp_path / f"absent {orders}.swz")]) == 2
    for told in capsys.readouterr():
        assert "[31mred" in told
        assert not set(orders) & set(told) - set("[31mred")


def test_an_error_with_closed_streams_still_has_its_status(tmp_path: Path):
    done = in_shell(f"{SW} list-plugins {shlex.quote(str(tmp_path))} >&- 2>&-")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


def test_a_closed_stream_is_not_taken_by_the_next_file(tmp_path: Path):
    """Else what is printed to stdout lands in the first file that was opened."""
    out = tmp_path / "out"
    done = in_shell(f"cd {shlex.quote(str(tmp_path))} && {SW} data synth {out} --size tiny >&- 2>&- <&-")
    assert done.returncode == 0, done.stderr
    assert (out / "sparse" / "0" / "cameras.bin").stat().st_size > 0
    written = b"".join(p.read_bytes() for p in out.rglob("*") if p.is_file())
    assert b"views" not in written


@pytest.mark.parametrize("command", ["list-plugins", "list-plugins --json", "--help"])
def test_a_reader_that_stops_reading_ends_a_command_quietly(command: str):
    # The reader is gone before anything is written.
    done = in_shell(f"(exec 3>&1; {SW} {command}; echo $? >&2) | true")
    assert done.stderr.strip() == "141"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_does_what_ctrl_c_does(number: signal.Signals):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), ended_like_ctrl_c():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_nohup_is_left_alone():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_like_ctrl_c():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_interrupted_fresh_run_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatwizard_core.cli.setup.Choices.resolve", interrupt)
    assert main(["train", "--scene", "demo:tiny", "--fresh", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.lstrip() == "interrupted (the same command without --fresh resumes a run)\n"


def test_a_full_disk_is_told_also_where_a_library_met_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/scratch/x")

    monkeypatch.setattr("splatwizard_core.cli.list_plugins.gather", full)
    assert main(["list-plugins"]) == 1
    told = capsys.readouterr().err
    assert told.startswith("error: /scratch/x: the disk is full; nothing half-written was kept")
    assert len(told.splitlines()) == 1


def test_a_request_to_end_is_heard_where_ctrl_c_is_ignored():
    """As it is for what a script starts in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt), ended_like_ctrl_c():
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)


def end_this_process() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_request_to_end_waits_for_a_part_that_may_be_interrupted():
    reached = []

    def work() -> None:
        with InterruptGuard() as guard:
            with guard.interruptible():
                reached.append("a part without one")
            end_this_process()
            reached.append("a step that is done whole")
            with guard.interruptible():
                reached.append("what is due after it")
            reached.append("never")

    with ended_like_ctrl_c(), pytest.raises(KeyboardInterrupt):
        work()
    assert reached == ["a part without one", "a step that is done whole", "what is due after it"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_request_to_end_after_the_last_such_part_is_heard_at_the_end():
    reached = []

    def work() -> None:
        with InterruptGuard():
            end_this_process()
            reached.append("saved")

    with ended_like_ctrl_c(), pytest.raises(KeyboardInterrupt):
        work()
    assert reached == ["saved"]


def test_a_request_to_end_is_heard_at_once_where_it_may_be_and_the_second_time_anywhere():
    heard = []

    def work() -> None:
        with InterruptGuard() as guard:
            try:
                with guard.interruptible():
                    end_this_process()
                    heard.append("late")
            except KeyboardInterrupt:
                heard.append("at once")
                end_this_process()  # while what is whole is saved, say
                heard.append("late")

    with ended_like_ctrl_c(), pytest.raises(KeyboardInterrupt):
        work()
    assert heard == ["at once"]


def test_progress_that_nobody_reads_does_not_end_the_work():
    with open("/dev/null") as unwritable, track("train", total=3, stream=unwritable) as bar:  # raises OSError
        bar._interval = 0.0
        for _ in range(3):
            bar.advance()
    assert bar.done == 3
