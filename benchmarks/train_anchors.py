"""Training speed of HAC, HAC++ and CAT-3DGS by phase, where a step's time goes, and 3DGS drawing as many beside.

    python benchmarks/train_anchors.py demo --preset quick --device cuda
    python benchmarks/train_anchors.py ../shared/data/fox:images_2 --iterations 7000 --device cuda --syncs
    python benchmarks/train_anchors.py demo --preset quick --iterations 300 --device cpu --methods hac
    python benchmarks/train_anchors.py ../shared/data/room --device cuda --graphs on,off --brief
    python benchmarks/train_anchors.py ../shared/data/room --device cuda --methods hac,cat-3dgs,hac-plus \
        --fused off,on --iterations 1000 --last --baseline-steps 0

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo. The plan of the preset is scaled to --iterations
(default: as the preset has it). Iterations a second count all steps of a phase but those that are profiled, growth and
pruning included. In the middle of each phase a window of steps is watched by torch.profiler: what share of a step's
time on the host, and on the GPU, goes into which part, forward and backward together (a backward operator counts where
its forward one ran); operators and kernels launched; and how often the host waits for the GPU (on a CPU: operators that
would make it wait). The profiler slows the host down: shares are those of a profiled step. --syncs lists the lines that
wait (CUDA only).
--graphs on,off trains twice, with the decoding as CUDA graphs and without, and prints both with the loss at the end.
--fused off,on trains twice, without and with the kernels for rows and networks of anchors, bits and lookups of planes.
Rows at the end compare the last phase of all trainings: steps per second of all of it and of its second quarter
(settled), what the GPU works a step and which share of a settled step that is; and on a GPU the peak of their memory
with that of HAC.

3DGS beside: the Gaussians that all anchors spawn for one view, thinned at random until views draw as many on average
as the anchors' last steps did, trained as 3DGS without densification and with all its spherical harmonics.
"""

from __future__ import annotations

import argparse
import collections
import gc
import itertools
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

# A profiler that is taken down and set up again does not survive graphs (torch issue 75504).
os.environ.setdefault("DISABLE_CUPTI_LAZY_REINIT", "1")
os.environ.setdefault("TEARDOWN_CUPTI", "0")

import torch
from scene_names import FORMS, split_scene
from step_parts import SECTION, kernel_times, longest_kernels, report
from sw_anchors.fast import networks, replay, rows, sample_bits
from torch.profiler import ProfilerActivity, profile, record_function

from splatwizard_core.base.random_states import seeded
from splatwizard_core.gaussians.inputs import rgb_to_dc
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.pretrained import make_method
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.images import decode_all, keep_pictures
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import Streams, stream
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from splatwizard_native import work_time
from sw_cat_3dgs.fast import plane_kernels, plane_sites

# Attribute paths from the trainer -> the part of a step that its calls belong to; what a version lacks is left out.
# Of nested ones the innermost counts.
PARTS = {
    "rasterizer.render": "rasterizer",
    "rasterizer.visible_filter": "visibility",
    "model.gaussians": "decoding",
    "model.draw_noise": "noise",
    "model.mlp_opacity.forward": "anchor MLPs",
    "model.mlp_cov.forward": "anchor MLPs",
    "model.mlp_color.forward": "anchor MLPs",
    "model.context.network.forward": "context MLPs",
    "model.context.slices.forward": "context MLPs",
    "model.grid.with_bits": "grid or planes",
    "model.context.triplane.forward": "grid or planes",
    "model.context_rows": "grid or planes",
    "model.context.triplane_bits": "planes' rate",
    "model._with_rate_of_visible": "rate",
    "model._with_rate_of_all": "rate",
    "stage.loss": "loss",
    "pre.exec": "plan before",
    "post.exec": "plan after",
    "optimizer.step": "optimizer",
    "optimizer.zero_grad": "optimizer",
}


@dataclass
class Phase:
    """Steps after `start` up to `end` of one run."""

    name: str
    start: int
    end: int
    seconds: float = 0.0
    steps: int = 0
    busy: float = 0.0  # milliseconds of the GPU per step, in the window that was watched
    settled: float = math.nan  # steps per second before that window: few graphs are captured, nothing grows any more
    lines: list[str] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Steps a second."""
        return self.steps / self.seconds if self.seconds else math.nan


@dataclass(frozen=True)
class Summary:
    """Outcome of one training: speed of its last phase and of that phase's second quarter, milliseconds of the GPU a
    step, loss, peak in GB."""

    method: str
    rate: float
    settled: float
    busy: float
    peak: float
    loss: float
    anchors: int

    def line(self, how: str, hac: Summary | None) -> str:
        """A row of the table at the end; hac: of HAC on the same scene."""
        memory = "" if math.isnan(self.peak) else f"  peak {self.peak:5.2f} GB"
        memory += f", {self.peak / hac.peak:.2f} of HAC's" if memory and hac is not None else ""
        return (
            f"  {self.method:10} {how:24} {self.rate:7.1f} it/s, settled {self.settled:7.1f}  GPU {self.busy:6.2f} ms, "
            f"{self.settled * self.busy / 10:3.0f} %  {self.anchors:9,} anchors  "
            f"loss {self.loss:.5f}{memory}"
        )


@contextmanager
def kernels_off() -> Iterator[None]:
    """Do without the kernels of rows and planes, as before there were any."""
    with ExitStack() as stack:
        for module in (rows, plane_kernels, plane_sites):
            stack.enter_context(mock.patch.object(module, "fit_kernels", return_value=False))
        stack.enter_context(mock.patch.object(networks, "fits_kernel", return_value=False))
        stack.enter_context(mock.patch.object(sample_bits, "fits", return_value=False))
        yield


def graphs_as(wanted: bool) -> AbstractContextManager[Any]:
    """Replay steps as CUDA graphs, or do not."""
    return nullcontext() if wanted else mock.patch.object(replay, "fits", return_value=False)


@dataclass
class Watch:
    """Called after each step: clocks every phase, and profiles `window` steps from its middle on."""

    device: torch.device
    phases: list[Phase]
    window: int
    syncs: bool
    kernels: int
    brief: bool
    losses: collections.deque[torch.Tensor] = field(default_factory=lambda: collections.deque(maxlen=500))
    _since: float = 0.0
    _settled_since: float = 0.0
    _profile: Any = None
    _caught: Any = None

    def begin(self) -> None:
        self._since = self._now()

    def __call__(self, record: TrainingState) -> None:
        step = record.step
        self.losses.append(record.total)
        phase = next((p for p in self.phases if p.start < step <= p.end), None)
        if phase is None:
            return
        middle = (phase.start + phase.end) // 2
        length = min(self.window, phase.end - middle - 1)
        if self._profile is None:
            phase.steps += 1
        quarter = (phase.end - phase.start) // 4
        if step == middle - quarter:
            self._settled_since = self._now()
        if step == middle:  # not after the window: what profiles stays in the process
            phase.settled = quarter / (self._now() - self._settled_since)
        if step == middle and length > 0:
            phase.seconds += self._now() - self._since
            self._profile = profile(activities=_activities(self.device))
            self._profile.__enter__()
        elif step == middle + length and self._profile is not None:
            self._now()
            self._profile.__exit__(None, None, None)
            if not self.brief:
                phase.lines = report(self._profile, length, cuda=self.device.type == "cuda", rows=record.model.num_rows)
            phase.busy = sum(t for t, _ in kernel_times(self._profile).values()) / length
            phase.lines += longest_kernels(self._profile, length, self.kernels)
            self._profile = None
            self._listen(on=self.syncs and self.device.type == "cuda")
            self._since = self._now()
        elif step == middle + length + 5 and self._caught is not None:
            phase.lines += self._listen(on=False)
        if step == phase.end:
            phase.seconds += self._now() - self._since
            self._since = self._now()

    def _listen(self, *, on: bool) -> list[str]:
        """Let torch warn of what waits, for five steps; then the lines it named."""
        if on:
            torch.cuda.synchronize()
            self._caught = warnings.catch_warnings(record=True)
            self._found = self._caught.__enter__()
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            return []
        if self._caught is None:
            return []
        torch.cuda.set_sync_debug_mode("default")
        self._caught.__exit__(None, None, None)
        self._caught = None
        places = collections.Counter("/".join(w.filename.split("/")[-2:]) + f":{w.lineno}" for w in self._found)
        return [f"      waits {count / 5:.1f} x a step at {place}" for place, count in places.most_common()]

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return work_time()


def _activities(device: torch.device) -> list[ProfilerActivity]:
    return [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (device.type == "cuda")


def mark_parts(trainer: Trainer) -> None:
    """Name the parts of a step for the profiler."""
    for path, name in PARTS.items():
        *owners, leaf = path.split(".")
        owner: Any = trainer.state
        for each in owners:
            owner = getattr(owner, each, None)
        if owner is not None and hasattr(owner, leaf):
            # Past nn.Module's own __setattr__ and pydantic's: a plain attribute of this object.
            object.__setattr__(owner, leaf, _named(getattr(owner, leaf), SECTION + name))


def _named(call: Callable[..., Any], name: str) -> Callable[..., Any]:
    def named(*args: Any, **kwargs: Any) -> Any:
        with record_function(name):
            return call(*args, **kwargs)

    return named


def phases_of(method: str, stage: Any) -> list[Phase]:
    """The phases of a plan, in steps of this run."""
    at, end = stage.opt.phases, stage.iterations
    if method in ("hac", "hac-plus"):
        names = ("full precision", "noise", "entropy")
        starts: tuple[int, ...] = (0, stage.when(at.quantized), stage.when(at.entropy))
    else:
        names = ("full precision", "noise", "entropy", "planes' rate alone", "planes fixed", "everything")
        steps = (at.quantize, at.triplane, at.warmup, at.scene, at.planes)
        starts = (0, *(stage.when(step) for step in steps))
    return [Phase(*each) for each in zip(names, starts, (*starts[1:], end), strict=True) if each[1] < each[2]]


def anchors(
    method: str, args: argparse.Namespace, session: Session, folder: str, pictures: str, *, graphs: bool, scenes: Any
) -> Summary:
    """Train and print one method, and 3DGS beside it."""
    cls = session.plugins.methods.load(method)
    planned = resolve(cls, args.preset, sets={}, scene=folder).config
    last = args.iterations or planned.iterations
    # The plan of a preset is for its own number of steps: scaled, it is that of a longer run, which ends at `last`.
    nominal = round(last / planned.iterations * cls.Config.FULL_ITERATIONS)
    sets: dict[str, Any] = {"iterations": nominal, "scale_schedule": True, "seed": args.seed}
    sets |= {"images": pictures} if pictures else {}
    resolved = resolve(cls, args.preset, sets=sets, scene=folder)
    if (folder, pictures) not in scenes:
        scenes[folder, pictures] = session.scene(resolved)
    scene = scenes[folder, pictures]
    made = make_method(session.plugins, resolved)
    rasterizer = NegotiatedRasterizer(session.plugins, device=session.device)
    with seeded(args.seed):
        model = made.create_model(scene, stream(args.seed, "init")).to(session.device)
        trainer = trainer_of(made.stages()[0], model, scene, resolved.ppl, rasterizer)
        phases = phases_of(method, trainer.state.stage)
        phases[-1].end = last
        if args.last:
            phases = phases[-1:]
        watch = Watch(session.device, phases, args.window, args.syncs, args.kernels, args.brief)
        drawn: list[Any] = []
        render = trainer.state.rasterizer.render

        def counted(*call: Any) -> Any:
            result = render(*call)
            if trainer.state.step >= last - 20:
                drawn.append((result.radii > 0).sum())
            return result

        object.__setattr__(trainer.state.rasterizer, "render", counted)
        if not args.brief:  # the marks take time
            mark_parts(trainer)

        def run() -> None:
            watch.begin()
            if phases[0].start > 0:
                trainer.run(phases[0].start, watch)
                watch.begin()
            trainer.run(last, watch)

        with graphs_as(graphs):
            with_pictures(scene, session.device, run)
    count = round(sum(int(d) for d in drawn) / max(len(drawn), 1))
    print(
        f"  {method}, {last:,} steps of preset {args.preset}, {trainer.state.model.num_rows:,} anchors, {count:,} drawn"
    )
    peak = math.nan
    cuda, prepared = session.device.type == "cuda", replay.DECODERS.get(trainer.state.model)
    if cuda:
        said = f"{prepared.captures} captures" if prepared is not None else "off"
        peak = torch.cuda.max_memory_allocated() / 1e9
        print(f"    graphs: {said}; peak {peak:.2f} GB")
    total = sum(phase.steps for phase in phases) / sum(phase.seconds for phase in phases)
    loss = float(torch.stack(list(watch.losses)).mean())
    print(f"    all phases: {total:.1f} it/s; mean loss of the last {len(watch.losses)} steps {loss:.5f}")
    for phase in phases:
        used = f", GPU busy {phase.busy * phase.rate / 10:.0f} % ({phase.busy:.2f} ms per step)" if cuda else ""
        print(f"    {phase.name:20} steps {phase.start + 1:,} to {phase.end:,}: {phase.rate:7.1f} it/s{used}")
        if phase.lines:
            print("\n".join(phase.lines), flush=True)
    found = Summary(
        method, phases[-1].rate, phases[-1].settled, phases[-1].busy, peak, loss, trainer.state.model.num_rows
    )
    if args.baseline_steps < 1:
        return found
    rate, drawn_there = explicit(trainer.state.model, count, args, session, scene, folder)
    print(f"    3DGS drawing {drawn_there:,} Gaussians per view: {rate:.1f} it/s", flush=True)
    return found


def trainer_of(stage: Any, model: Any, scene: Scene, ppl: Any, rasterizer: Any) -> Trainer:
    """As `TrainingRun` makes it."""
    streams = Streams(ppl.seed)

    def none(name: str) -> Any:
        raise AssertionError(f"starts from no {name}")

    model = stage.begin(StageContext(model, scene, ppl, rasterizer, streams, none))
    return Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))


def with_pictures(scene: Scene, device: torch.device, run: Callable[[], None]) -> None:
    decode_all(scene.train)
    keep_pictures(scene.train, device)
    try:
        run()
    finally:
        keep_pictures(scene.train, "cpu")


def explicit(
    model: Any, count: int, args: argparse.Namespace, session: Session, scene: Scene, folder: str
) -> tuple[float, int]:
    """(iterations a second, Gaussians drawn a view) of 3DGS on some of the model's Gaussians."""
    rasterizer = NegotiatedRasterizer(session.plugins, device=session.device)
    with torch.no_grad():
        camera = scene.train[0].camera.to(session.device)
        found = model.eval().decode(camera, torch.arange(model.num_rows, device=session.device))
        n = len(found)
        options = RasterOptions(background=scene.background.to(session.device))

        def drawn(g: GaussianModel) -> int:
            views = scene.train[:: max(1, len(scene.train) // 8)]
            cameras = [view.camera.to(session.device) for view in views]
            radii = [rasterizer.render(g.gaussians(c, rasterizer), c, options).radii for c in cameras]
            return round(sum(int((r > 0).sum()) for r in radii) / len(radii))

        def some(share: float) -> GaussianModel:
            rows = torch.randperm(n, generator=stream(args.seed, "thin"))[: max(1, round(share * n))]
            rows = rows.to(session.device)
            return GaussianModel(
                found.means[rows], rgb_to_dc(found.colors[rows])[:, None], found.means.new_zeros(len(rows), 15, 3),
                torch.logit(found.opacities[rows].clamp(1e-3, 0.999)), found.scales[rows].clamp(min=1e-6).log(),
                found.quats[rows],
            )  # fmt: skip

        everything = drawn(some(1.0))
        splats = some(min(1.0, count / max(everything, 1)))
        drawn_there = drawn(splats)
    steps = args.baseline_steps
    cls = session.plugins.methods.load("3dgs")
    sets = {"iterations": steps, "density.settings.stop": 0, "density.settings.white_reset": 0, "seed": args.seed}
    resolved = resolve(cls, "paper", sets=sets, scene=folder)
    trainer = trainer_of(make_method(session.plugins, resolved).stages()[0], splats, scene, resolved.ppl, rasterizer)
    clock: dict[int, float] = {}

    def after(record: TrainingState) -> None:
        if record.step in (steps // 5, steps):
            if session.device.type == "cuda":
                torch.cuda.synchronize()
            clock[record.step] = work_time()

    def run() -> None:
        trainer.run(steps, after)

    with_pictures(scene, session.device, run)
    return (steps - steps // 5) / (clock[steps] - clock[steps // 5]), drawn_there


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=FORMS)
    parser.add_argument("--methods", default="hac,cat-3dgs")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--iterations", type=int, default=0, help="default: those of the preset")
    parser.add_argument("--window", type=int, default=20, help="steps that are profiled in each phase")
    parser.add_argument("--baseline-steps", type=int, default=500, help="of 3DGS; 0: none")
    parser.add_argument("--graphs", default="on", help="decode as CUDA graphs: on, off or on,off")
    parser.add_argument("--fused", default="on", help="kernels of rows and planes: on, off or off,on (CUDA)")
    parser.add_argument("--last", action="store_true", help="watch the last phase alone")
    parser.add_argument("--kernels", type=int, default=0, help="list so many kernels that take the most time (CUDA)")
    parser.add_argument("--brief", action="store_true", help="no table of parts")
    parser.add_argument("--syncs", action="store_true", help="also which lines wait for the GPU")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("torch sees no CUDA device here")
    session = Session(load_plugins(), torch.device(args.device), lambda line: print(line, file=sys.stderr))
    where = torch.cuda.get_device_name(0) if args.device == "cuda" else f"CPU, {torch.get_num_threads()} thread(s)"
    print(f"{where}, torch {torch.__version__}")
    scenes: dict[tuple[str, str], Scene] = {}
    for asked in args.scenes:
        folder, pictures = split_scene(asked, session.plugins)
        print(asked)
        rows: list[tuple[str, Summary]] = []
        for method in args.methods.split(","):
            for graphs, fused in itertools.product(args.graphs.split(","), args.fused.split(",")):
                gc.collect()  # the last training, whose rasterizer points back at it: its memory is not this one's
                if args.device == "cuda":
                    torch.cuda.empty_cache()
                    torch.cuda.reset_peak_memory_stats()
                print(f"  graphs {graphs}, kernels {fused}")
                with nullcontext() if fused == "on" else kernels_off():
                    found = anchors(method, args, session, folder, pictures, graphs=graphs == "on", scenes=scenes)
                rows.append((f"graphs {graphs}, kernels {fused}", found))
        hac = {how: found for how, found in rows if found.method == "hac"}
        print("\n".join([asked, *(found.line(how, hac.get(how)) for how, found in rows)]), flush=True)


if __name__ == "__main__":
    main()
