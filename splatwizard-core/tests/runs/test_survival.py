"""A run that is killed at any point goes on to the same result, and nobody who looks meanwhile sees half a file."""

import hashlib
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from forked_children import run_python, start_python

from splatwizard_core.base.files import TEMPORARY
from splatwizard_core.plugins import PluginManager
from splatwizard_core.training.checkpoint import CheckpointStore

pytestmark = pytest.mark.pipeline

SEED = 20_240_607
POINTS = 30
RUN = ("run", "--method", "toy", "--scene", "demo:tiny", "--set", "iterations=12", "--set", "checkpoint_every=3")
TIMES = {
    "seconds",
    "date",
    "contended",
    "speed",
    "memory",
    "peak_bytes",
    "peak_decode_bytes",
    "decode_runs_s",
    "decode_spread",
}
"""Keys of the record that hold what was measured of this process rather than of the scene; and all that end in _s."""

READER = """
    import json, sys, time
    from pathlib import Path

    from PIL import Image
    from splatwizard_core.coding.container import ContainerReader
    from splatwizard_core.errors import BitstreamError
    from splatwizard_core.runs.config import read_config_file
    from splatwizard_core.runs.record import read_record
    from splatwizard_core.training.checkpoint import read_checkpoint

    def lines(path):
        text = path.read_text()
        for line in text[: text.rfind("\\n") + 1].splitlines():
            assert json.loads(line)["step"] >= 1

    def picture(path):
        with Image.open(path) as opened:
            opened.load()

    READ = {
        "metrics.json": read_record, "steps.json": lambda p: json.loads(p.read_text()), "log.jsonl": lines,
        "config.toml": read_config_file, "scene.swz": ContainerReader.open, "checkpoints/*.json": read_checkpoint,
        "renders/*.png": picture,
    }
    looks, counts = 0, dict.fromkeys(READ, 0)
    directory, stop, last = Path(sys.argv[1]), Path(sys.argv[2]), False
    print("looks", flush=True)
    while not last:
        looks, last = looks + 1, stop.exists()  # once more after the end, when everything is there
        for pattern, read in READ.items():
            for path in directory.glob(pattern):
                try:
                    read(path)
                    counts[pattern] += 1
                except Exception as error:
                    # A checkpoint, or anything of a run that starts again, may be gone by now; half of one may not be.
                    if path.exists() and "is missing" not in str(error):
                        sys.exit(f"{path}: {type(error).__name__}: {error}")
        time.sleep(0.1)
    print(json.dumps({"looks": looks, **counts}))
"""


@dataclass
class Life:
    """A run in processes of its own that may be killed.

    out     root of its run directories
    """

    folder: Path
    log: list[str] = field(default_factory=list)

    @property
    def directory(self) -> Path:
        return self.folder / "out" / "demo-tiny" / "toy" / "r2"

    def interrupt(self, after: float) -> int:
        """Press Ctrl-C, which all processes at a terminal get, after some seconds; the exit status."""
        process = self.start()
        try:
            _, told = process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGINT)
            _, told = process.communicate()
        self.log.append(told)
        return process.returncode

    @property
    def command(self) -> list[str]:
        return ["-m", "splatwizard_core", *RUN, "--out", str(self.folder / "out")]

    def environment(self, death: str | None = None) -> dict[str, str]:
        temporary = self.folder / "tmp"
        temporary.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, "TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
        if death is not None:
            environment |= {"TOY_DEATH": death, "TOY_WRITES": str(self.folder / "writes")}
        return environment

    def start(self) -> subprocess.Popen[str]:
        """Begin in a new interpreter, importing included."""
        return subprocess.Popen(
            [sys.executable, *self.command], env=self.environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, start_new_session=True,
        )  # fmt: skip

    def live(self, death: str | None = None) -> int:
        """Run until the end, or the death before a write; the exit status."""
        done = run_python(*self.command, env=self.environment(death))
        self.log.append(done.stderr)
        return done.returncode

    def kill(self, after: float) -> None:
        """Kill a run after some seconds, if it has not ended by then."""
        process = self.start()
        try:
            _, told = process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            process.kill()
            _, told = process.communicate()
        self.log.append(told)

    @property
    def writes(self) -> list[str]:
        """What was about to be written, in order, as `run os.rename PATH`."""
        return (self.folder / "writes").read_text().splitlines()

    def left(self) -> list[Path]:
        """Temporary files and folders."""
        import re

        found = [p for p in (self.folder / "out").rglob("*") if re.fullmatch(rf".*{TEMPORARY}", p.name)]
        return [*found, *(self.folder / "tmp").iterdir()]


def timeless(value: Any) -> Any:
    """A record without what no two runs share."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if k not in TIMES and not k.endswith("_s")}
    return [timeless(v) for v in value if v != "contended"] if isinstance(value, list) else value


def outcome(directory: Path) -> dict[str, Any]:
    """All that a finished run leaves, times apart."""
    saved = CheckpointStore(directory / "checkpoints").restored(lambda found: found)
    assert saved is not None

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        if isinstance(value, list):
            return [plain(v) for v in value]
        return hashlib.sha256(value.numpy().tobytes()).hexdigest() if hasattr(value, "numpy") else value

    return {
        "names": sorted(p.relative_to(directory).as_posix() for p in directory.rglob("*")),
        "file": (directory / "scene.swz").read_bytes(),
        "trained": plain(saved.state),
        "record": timeless(json.loads((directory / "metrics.json").read_text())),
        "renders": {p.name: p.read_bytes() for p in (directory / "renders").iterdir()},
        "log": (directory / "log.jsonl").read_text(),
        "config": (directory / "config.toml").read_text(),
    }


@dataclass
class Undisturbed:
    """A run that nobody kills: what comes out, the writes on the way, and how long it takes."""

    outcome: dict[str, Any]
    writes: list[str]
    seconds: float


@pytest.fixture(scope="module")
def undisturbed(toy_plugins: PluginManager, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    life = Life(tmp_path_factory.mktemp("undisturbed"))
    began = time.monotonic()
    assert life.live("run:0") == 0, life.log
    seconds = time.monotonic() - began
    assert life.left() == []
    return Undisturbed(outcome(life.directory), life.writes, seconds)


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that reads everything in the run directory of Life(tmp_path) again and again."""
    directory = Life(tmp_path).directory
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = start_python("-c", textwrap.dedent(READER), str(directory), str(tmp_path / "stop"), **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == "looks\n"
    yield process
    process.kill()
    process.communicate()


def test_four_deaths_in_one_run_change_nothing_and_no_reader_sees_half_a_file(
    undisturbed: Undisturbed, tmp_path: Path, reader: subprocess.Popen[str]
):
    """Killed while training, after encoding, while it draws, and at the end; each time what is left is gone on with."""
    dice = random.Random(SEED)
    before = itertools.takewhile(lambda line: "scene.swz" not in line, undisturbed.writes)
    training = sum("/out/" in line for line in before)  # kernels that the first run compiled are there by now
    life = Life(tmp_path)
    deaths = [
        f"run:{dice.randint(1, training)}",
        "run:splatwizard-decode",
        f"eval:{dice.randint(1, 4)}",
        "run:.metrics.json",
    ]
    for death in deaths:
        assert life.live(death) == -signal.SIGKILL, (death, life.log[-1])
    assert life.live() == 0, life.log[-1]
    (tmp_path / "stop").touch()
    counts, told = reader.communicate()
    assert reader.returncode == 0, told
    assert all(json.loads(counts).values()), counts
    assert json.loads(counts)["looks"] > len(deaths), counts
    assert life.left() == []
    assert outcome(life.directory) == undisturbed.outcome
    # Told what happened before, and by whom.
    assert "ended without finishing" in life.log[-1]
    assert all(log.count("training toy") == 0 for log in life.log[3:]), "the training was finished before"


@pytest.mark.slow
@pytest.mark.parametrize("point", range(POINTS))
def test_a_run_that_is_killed_anywhere_comes_to_the_same(point: int, undisturbed: Undisturbed, tmp_path: Path):
    """Every second point is before one of its writes, the others anywhere in its time, importing included."""
    dice = random.Random(SEED + point)
    life = Life(tmp_path)
    if point % 2:
        number = dice.randrange(len(undisturbed.writes))
        command = undisturbed.writes[number].split()[0]
        nth = sum(w.startswith(f"{command} ") for w in undisturbed.writes[: number + 1])
        status = life.live(f"{command}:{nth}")
        assert status == -signal.SIGKILL, life.log
    else:
        # One slice of its time for each point, so that all of it is met.
        life.kill(after=undisturbed.seconds * (point + 2 * dice.random()) / POINTS)
    assert life.live() == 0, life.log
    assert life.left() == []
    assert outcome(life.directory) == undisturbed.outcome


@pytest.mark.slow
@pytest.mark.parametrize("point", range(6))
def test_ctrl_c_anywhere_is_one_line_and_comes_to_the_same(point: int, undisturbed: Undisturbed, tmp_path: Path):
    dice = random.Random(SEED - point)
    life = Life(tmp_path)
    # The first half second is Python's own start, which knows no better than a traceback.
    status = life.interrupt(0.5 + (undisturbed.seconds - 0.5) * (point + dice.random()) / 6)
    assert status in (0, 130), life.log
    assert "Traceback" not in life.log[-1]
    assert ("interrupted (the same command resumes a run)" in life.log[-1]) == (status == 130)
    assert life.live() == 0, life.log
    assert life.left() == []
    assert outcome(life.directory) == undisturbed.outcome
