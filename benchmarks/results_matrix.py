"""Run methods x scenes x seeds on several GPUs, several runs a GPU, until a deadline; then measure rendering alone.

    python benchmarks/results_matrix.py out/h200 --scenes DATA/fox:images_2,DATA/room,DATA/lego --gpus 4 --per-gpu 3
        --deadline 850
    python benchmarks/results_matrix.py out/tiny --preset quick --scenes demo:tiny --methods 3dgs,lightgaussian
    python tools/results.py collect out/h200          # small records into docs/records, and the tables

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo.

A run is `sw run` into OUT/seed-N/<scene>/<method>/<rate>, one of a variant (`3dgs:mcmc`: method and preset) into
OUT/seed-N-mcmc/... . What is finished is skipped, what was interrupted goes on from its checkpoint: the same command
continues. The trained 3DGS scene that methods start from is that seed's run of 3dgs, so those methods wait for it;
whatever starts from points does not, and the longest go first, seed by seed.

--deadline SECONDS counts from the start. --quiet SECONDS before it, runs are interrupted (they keep a checkpoint), and
`sw eval` measures speed and memory of each finished file again, one process a GPU: those figures, the command and the
number of processes a GPU go into matrix.json beside metrics.json. Without a deadline everything is finished first.
Training times count as measured alone where --per-gpu is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import shlex
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from scene_names import FORMS, split_scene

from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.runs.pretrained import named_scenes
from splatwizard_native import available_cores

METHODS = "3dgs,3dgs:mcmc,lightgaussian,chimerags,hac,cat-3dgs"
SWEEPS = ("3dgs",)  # all of whose rate points share one training
MOMENT = 0.2  # seconds between two looks at what runs
COARSE = 2.0  # seconds by which a file may seem older than it is
PATIENCE = 30.0  # seconds from an interrupt to its checkpoint


@dataclass(frozen=True)
class Job:
    """One `sw run`.

    method, variant     variant: preset of its own, "" for that of the command line
    needs               method whose trained scene it starts from or is taught by: its run of the same scene and seed
                        goes first, if that is part of the matrix; "" for none
    cost                steps of its own: what takes longest begins first
    """

    method: str
    variant: str
    scene: str
    images: str
    seed: int
    rates: str
    needs: str
    cost: int
    default_rate: str

    @property
    def name(self) -> str:
        return f"{self.method}{':' * bool(self.variant)}{self.variant} {Path(self.scene).name} seed {self.seed}"

    def out(self, root: Path) -> Path:
        """The --out of its run: variants of a method must not share one."""
        return root / f"seed-{self.seed}{'-' * bool(self.variant)}{self.variant}"

    def folder(self, root: Path) -> Path:
        """Folder of its rate points."""
        return self.out(root) / scene_name(self.scene) / self.method

    def runs(self, root: Path) -> list[Path]:
        """Its finished run directories."""
        return sorted(path.parent for path in self.folder(root).glob("*/metrics.json"))

    def command(self, root: Path, preset: str, device: str, sets: list[str]) -> list[str]:
        words = ["run", "--method", self.method, "--scene", self.scene, "--seed", str(self.seed), "--rate", self.rates]
        words += ["--preset", self.variant or preset, "--device", device, "--out", str(self.out(root))]
        words += ["--images", self.images] if self.images else []
        asked = [value.partition("@") for value in sets]
        fitting = [value for value, _, method in asked if method in ("", self.method)]
        return [*words, *(word for value in fitting for word in ("--set", value))]


def scene_name(scene: str) -> str:
    """Name of a scene's folder below --out, as `sw run` makes it; demo:tiny is demo-tiny."""
    path = Path(scene)
    return (path.resolve() if path.exists() else path).name.replace(":", "-")  # a link is followed


def asked(text: str) -> tuple[str, str, str]:
    """Split METHOD[:PRESET][@RATE+RATE...] into method, preset and a comma list of rates."""
    name, _, rates = text.partition("@")
    method, _, variant = name.partition(":")
    return method, variant, rates.replace("+", ",")


def jobs(args: argparse.Namespace, plugins: PluginManager) -> list[Job]:
    """Everything that is to run, in the order in which to start: seed by seed, then the longest first."""
    found = []
    methods = [asked(text) for text in args.methods.split(",")]
    plain = {method for method, variant, _ in methods if not variant}
    for seed in map(int, args.seeds.split(",")):
        for scene, images in (split_scene(text, plugins) for text in args.scenes.split(",")):
            for method, variant, own in methods:
                cls = plugins.methods.load(method)
                bases = named_scenes(cls(plugins, cls.Config()))
                rates = own or args.rates or ("all" if method in SWEEPS and not variant else "default")
                steps = cls.Config.FULL_ITERATIONS
                needed_soon = 10**6 if any(m not in SWEEPS for m in plain) and method in SWEEPS and not variant else 0
                found.append(Job(method, variant, scene, images, seed, rates,
                                 bases[0] if bases else "", steps + needed_soon, cls.DEFAULT_RATE))  # fmt: skip
    return sorted(found, key=lambda job: (job.seed, -job.cost))


class Matrix:
    """The runs of one command: who is due, who is running, who failed."""

    def __init__(self, args: argparse.Namespace, work: list[Job]) -> None:
        self.args, self.work = args, work
        self.root: Path = args.out
        self.began = time.monotonic()
        self.failed: list[str] = []
        self.done = {job for job in work if self.finished(job)}
        self._lock = threading.Lock()
        self._slots: queue.SimpleQueue[str] = queue.SimpleQueue()
        for _ in range(args.per_gpu):
            for gpu in args.gpu_names:
                self._slots.put(gpu)

    def left(self, reserve: float = 0.0) -> float:
        """Seconds until the deadline, or until `reserve` before it."""
        deadline: float | None = self.args.deadline
        return float("inf") if deadline is None else deadline - reserve - (time.monotonic() - self.began)

    def finished(self, job: Job) -> bool:
        """Whether an earlier call noted that its `sw run` ended well."""
        note = job.folder(self.root) / "finished.json"
        return note.exists() and json.loads(note.read_text("utf-8"))["command"] == self.command(job)

    def command(self, job: Job) -> str:
        return shlex.join(["sw", *job.command(self.root, self.args.preset, self.args.device, self.args.set)])

    def train_all(self) -> None:
        """Run what is due on free places until nothing is left, or the time is up."""
        waiting = [job for job in self.work if job not in self.done]
        for job in self.done:
            print(f"finished before: {job.name}", flush=True)
        running: set[Job] = set()
        with ThreadPoolExecutor(max(1, len(self.args.gpu_names) * self.args.per_gpu)) as pool:
            while (waiting or running) and self.left(self.args.quiet) > 0:
                due = next((job for job in waiting if self._ready(job)), None)
                if due is None and not running:
                    self.failed += [f"{job.name}: what it starts from has failed" for job in waiting]
                    break
                if due is None or self._slots.empty():
                    time.sleep(MOMENT)
                    with self._lock:
                        running = {job for job in running if job not in self.done}
                    continue
                waiting.remove(due)
                running.add(due)
                pool.submit(self._train, due, self._slots.get())
        if waiting and self.left(self.args.quiet) <= 0:
            print(f"no time for {len(waiting)} runs, the first of them {waiting[0].name}", flush=True)

    def _ready(self, job: Job) -> bool:
        """Whether what it starts from is there, or nobody else is to train it."""
        same = [j for j in self.work if (j.method, j.variant, j.scene, j.seed) == (job.needs, "", job.scene, job.seed)]
        return all(self.finished(j) for j in same)

    def _train(self, job: Job, gpu: str) -> None:
        began, at = time.monotonic(), time.time()
        try:
            places = len(self.args.gpu_names) * self.args.per_gpu
            words = job.command(self.root, self.args.preset, self.args.device, self.args.set)
            folder = job.folder(self.root)
            folder.mkdir(parents=True, exist_ok=True)
            with open(folder / "output.txt", "a", encoding="utf-8") as output:
                status = self._call(words, gpu, places, output, self.left(self.args.quiet))
            took = time.monotonic() - began
            if status == 0:
                for run in job.runs(self.root):
                    if _read(run / "matrix.json") and (run / "metrics.json").stat().st_mtime < at - COARSE:
                        continue  # made by another command, that of other rate points
                    facts = {"command": self.command(job), "processes_per_gpu": self.args.per_gpu}
                    _update(run / "matrix.json", facts)
                _update(folder / "finished.json", {"command": self.command(job)})
                print(f"{took:6.0f} s  {job.name}", flush=True)
            elif self.left(self.args.quiet) <= 0:
                print(f"{took:6.0f} s  {job.name}: interrupted, goes on with the same command", flush=True)
            else:
                self.failed.append(f"{job.name}: exit status {status}, see {folder / 'output.txt'}")
                print(f"{took:6.0f} s  {job.name}: FAILED", flush=True)
        finally:
            with self._lock:
                self.done.add(job)
            self._slots.put(gpu)

    def _call(self, words: list[str], gpu: str, places: int, output: object, limit: float) -> int:
        """Exit status of one `sw`; interrupted when its time is up, so that it leaves a checkpoint."""
        # More threads than cores wait for one another in loops.
        environment = {"OMP_NUM_THREADS": str(max(1, available_cores() // places)), **os.environ}
        environment |= {"CUDA_VISIBLE_DEVICES": gpu} if gpu else {}
        process = subprocess.Popen(
            [sys.executable, "-m", "splatwizard_core", *words],
            env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,  # type: ignore[call-overload]
        )  # fmt: skip
        try:
            return int(process.wait(None if limit == float("inf") else max(limit, 0.1)))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            try:
                return int(process.wait(PATIENCE)) or 1
            except subprocess.TimeoutExpired:
                process.kill()
                return process.wait() or 1

    def measure_all(self) -> None:
        """Speed and memory of every file, each alone on a GPU; seed by seed, what was measured is skipped."""
        gpus: queue.SimpleQueue[str] = queue.SimpleQueue()
        for gpu in self.args.gpu_names:
            gpus.put(gpu)
        due = [(job, run) for job in self.work for run in job.runs(self.root) if self._unmeasured(job, run)]
        with ThreadPoolExecutor(len(self.args.gpu_names)) as pool:
            told = list(pool.map(lambda pair: self._measure(*pair, gpus), due))
        if told.count(False):
            print(f"{told.count(False)} of {len(told)} files were not measured alone: the same command goes on")

    def _unmeasured(self, job: Job, run: Path) -> bool:
        """Whether it lacks its figures; of several rate points the default one alone gets them."""
        wanted = ("," not in job.rates and job.rates != "all") or run.name == job.default_rate
        return wanted and not _read(run / "matrix.json").get("quiet")

    def _measure(self, job: Job, run: Path, gpus: queue.SimpleQueue[str]) -> bool:
        gpu = gpus.get()
        try:
            if self.left() <= 0:
                return False
            words = ["eval", str(run / "scene.swz"), "--scene", job.scene, "--metrics", "psnr", "--json"]
            words += ["--device", self.args.device] + (["--images", job.images] if job.images else [])
            answer = run / "quiet.txt"
            with open(answer, "w", encoding="utf-8") as output:
                status = self._call(words, gpu, len(self.args.gpu_names), output, self.left())
            text = answer.read_text("utf-8")
            answer.unlink()
            if status != 0 or "{" not in text:
                self.failed.append(f"{run}: `sw eval` ended with {status}: {text.strip().splitlines()[-1:]}")
                return False
            facts = json.JSONDecoder().raw_decode(text[text.index("{") :])[0]
            quiet = {"speed": facts["speed"], "memory": facts["memory"]}
            _update(run / "matrix.json", {"quiet": quiet})
            return True
        finally:
            gpus.put(gpu)


def _read(path: Path) -> dict[str, object]:
    return json.loads(path.read_text("utf-8")) if path.exists() else {}  # type: ignore[no-any-return]


def _update(path: Path, facts: dict[str, object]) -> None:
    path.write_text(json.dumps(_read(path) | facts, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    parser.add_argument("--scenes", required=True, help=f"comma list; each is {FORMS}")
    parser.add_argument(
        "--methods", default=METHODS, help=f"comma list of METHOD[:PRESET][@RATE+RATE...] (default: {METHODS})"
    )
    parser.add_argument("--seeds", default="0,1,2", help="comma list (default: 0,1,2)")
    parser.add_argument("--rates", default="", help="of every method (default: all of 3dgs, the default of the others)")
    parser.add_argument("--preset", default="paper", help="of what names none (default: paper)")
    parser.add_argument("--gpus", type=int, default=0, help="how many (default: all that are visible; 0 on a CPU)")
    parser.add_argument("--per-gpu", type=int, default=1, help="runs at a time on each (default: 1)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE[@METHOD]",
                        help="for all runs, or those of one method")  # fmt: skip
    parser.add_argument("--deadline", type=float, help="seconds from now at which everything has ended")
    parser.add_argument("--quiet", type=float, default=120, help="of these, for measuring alone (default: 120)")
    parser.add_argument("--no-measure", action="store_true", help="leave out the measuring alone")
    parser.add_argument("--list", action="store_true", help="print what would run, in order")
    args = parser.parse_args()
    visible = [gpu for gpu in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if gpu]
    if not visible and args.device != "cpu":
        import torch

        visible = [str(i) for i in range(torch.cuda.device_count())]
    args.gpu_names = (visible[: args.gpus] if args.gpus else visible) or [""]
    matrix = Matrix(args, jobs(args, load_plugins()))
    if args.list:
        print("\n".join(f"{job.name:40} {matrix.command(job)}" for job in matrix.work))
        return 0
    matrix.train_all()
    if not args.no_measure:
        matrix.measure_all()
    print("\n".join(matrix.failed))
    return 1 if matrix.failed else 0


if __name__ == "__main__":
    sys.exit(main())
