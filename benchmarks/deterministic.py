"""Whether `deterministic=true` gives the same file three times on a GPU, where runs part if not, and what it costs.

    python benchmarks/deterministic.py demo --ops
    python benchmarks/deterministic.py nerf_synthetic:DATA/chair --iterations 1500 --set resolution=2 --jobs 7
    python benchmarks/deterministic.py demo --preset quick --iterations 0 --methods hac,2dgs --gpus 0,1 --out out/twice

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo. The plan of --preset is scaled to --iterations, that of
a scene which a method starts from too; 0: as the preset has it, which preset quick wants.

1. Each method trains --runs times with one seed, and encodes, in processes of its own, --jobs of them at once on each
   of --gpus: neighbours on a GPU change when its blocks end, which must change no bit. Compared is the SHA-256 of the
   file. Every loss is logged, and every --every steps each tensor of the model has a digest: where files differ, the
   first step whose loss differs and the first tensors that do are told. --control adds as many runs without the key.
2. Then, one method at a time, two trainings of one process take turns of --turn steps, with the key and without: steps
   a second of both and the median of the ratios of neighbouring turns. --no-timing leaves it out.

--ops instead runs each operation with gradients by atomics twice and more on random tensors, with the key and without:
whether its bits are equal, how far both are apart, and milliseconds.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import itertools
import json
import os
import queue
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from scene_names import FORMS, split_scene
from torch import Tensor

from splatwizard_core.base.random_states import one_order_of_sums, seeded

METHODS = "3dgs,2dgs,hac,hac-plus,cat-3dgs,compact3dgs,lightgaussian"
REPEATS = 5  # of an operation


# 1. Digests


@dataclass
class Run:
    """One training and its file. `digest` is None if it failed; `output` tells why."""

    method: str
    number: int
    deterministic: bool
    folder: Path
    digest: str | None = None
    size: int = 0
    output: str = ""

    @property
    def name(self) -> str:
        return f"{self.method} run {self.number}{'' if self.deterministic else ' (without the key)'}"

    def directory(self) -> Path | None:
        """Run directory, once it has a log; that of a scene which the method starts from is another one."""
        logs = self.folder.glob("*/*/*/log.jsonl")
        return next((path.parent for path in logs if path.parent.parent.name == self.method), None)

    def losses(self) -> dict[tuple[int, int], float]:
        """Loss by (stage, step)."""
        directory = self.directory()
        lines = [] if directory is None else map(json.loads, (directory / "log.jsonl").read_text().splitlines())
        return {(line["stage"], line["step"]): line["loss"] for line in lines if "loss" in line}

    def digests(self) -> dict[tuple[int, int, int], dict[str, str]]:
        """Digest of each tensor by (place in the file, stage, step): a scene that a method starts from is there too."""
        path = self.folder / "digests.jsonl"
        lines = map(json.loads, path.read_text().splitlines()) if path.exists() else []
        return {(i, line["stage"], line["step"]): line["tensors"] for i, line in enumerate(lines)}


def train_with_digests() -> None:
    """Run `sw` in this process, and write digests of the model's tensors on the way."""
    from splatwizard_core.training.trainer import Trainer

    _, _, path, every, *words = sys.argv
    run = Trainer.run

    def run_with_digests(trainer: Any, until: int, after_step: Callable[[Any], None]) -> None:
        def after(record: Any) -> None:
            state = trainer.state
            if state.step % int(every) == 0 or state.finished:
                tensors = {name: digest_of(tensor) for name, tensor in state.model.state_dict().items()}
                line = {"stage": state.index, "step": state.step, "tensors": tensors}
                with Path(path).open("a") as file:
                    file.write(json.dumps(line) + "\n")
            after_step(record)

        run(trainer, until, after)

    Trainer.run = run_with_digests  # type: ignore[method-assign]
    sys.argv = ["sw", *words]
    runpy.run_module("splatwizard_core", run_name="__main__", alter_sys=True)


def digest_of(tensor: Tensor) -> str:
    content = tensor.detach().cpu().contiguous().view(-1)
    raw = content.view(torch.uint8).numpy().tobytes() if tensor.numel() else b""
    return hashlib.sha256(f"{tuple(tensor.shape)}".encode() + raw).hexdigest()[:12]


def call(words: list[str], gpu: str) -> tuple[int, str]:
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": gpu} if gpu else os.environ
    done = subprocess.run(words, env=environment, capture_output=True, text=True, errors="replace", check=False)
    return done.returncode, done.stdout + done.stderr


def make(run: Run, args: argparse.Namespace, gpus: queue.Queue[str]) -> Run:
    """Train and encode."""
    gpu = gpus.get()
    try:
        options = run_options(run.method, args)
        options += ["--set", f"deterministic={str(run.deterministic).lower()}", "--set", "log_every=1"]
        options += ["--set", "checkpoint_every=1000000000", "--set", f"threads={args.threads}"]
        digests = run.folder / "digests.jsonl"
        run.folder.mkdir(parents=True, exist_ok=True)
        digests.unlink(missing_ok=True)  # of an earlier command with the same --out
        train = ["train", *options, "--fresh", "--out", str(run.folder)]
        status, run.output = call([sys.executable, __file__, "train", str(digests), str(args.every), *train], gpu)
        directory = run.directory()
        if status == 0 and directory is not None:
            file = run.folder / "scene.swz"
            words = ["encode", str(directory), "--out", str(file), "--device", args.device]
            status, run.output = call([sys.executable, "-m", "splatwizard_core", *words], gpu)
            if status == 0:
                run.digest, run.size = hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_size
    finally:
        gpus.put(gpu)
    print(f"  {run.name}: {run.digest or 'FAILED'}", file=sys.stderr, flush=True)
    return run


def run_options(method: str, args: argparse.Namespace) -> list[str]:
    options = ["--method", method, "--scene", args.scene, "--seed", str(args.seed), "--device", args.device]
    options += ["--images", args.images] if args.images else []
    options += ["--preset", args.preset]
    return options + [word for assignment in assignments(method, args) for word in ("--set", assignment)]


def assignments(method: str, args: argparse.Namespace) -> list[str]:
    """KEY=VALUE that a training of the method gets; `args.starting` are those that start from a trained scene."""
    scaled = [f"iterations={args.iterations}", "scale_schedule=true"] if args.iterations else []
    return [*args.set, *scaled, *(f"pretrained.{each}" for each in scaled if method in args.starting)]


def told(runs: list[Run]) -> list[str]:
    """Say where runs of one method part."""
    failed = [
        f"{run.name} failed: {' | '.join(run.output.strip().splitlines()[-3:])}" for run in runs if not run.digest
    ]
    losses, digests = [run.losses() for run in runs], [run.digests() for run in runs]
    lines = []
    common = sorted(set.intersection(*map(set, losses)) if losses else set())
    parted = next((at for at in common if len({found[at] for found in losses}) > 1), None)
    if parted is not None:
        values = ", ".join(f"{found[parted]!r}" for found in losses)
        lines.append(f"first loss that differs: stage {parted[0]}, step {parted[1]}: {values}")
    marks = sorted(set.intersection(*map(set, digests)) if digests else set())
    last_equal = "the start"
    for at in marks:
        names = [name for name in digests[0][at] if len({found[at].get(name) for found in digests}) > 1]
        if names:
            lines.append(
                f"tensors that differ at stage {at[1]}, step {at[2]} (equal at {last_equal}): {', '.join(names)}"
            )
            break
        last_equal = f"stage {at[1]}, step {at[2]}"
    else:
        if len({run.digest for run in runs}) > 1 and not failed:
            lines.append("all tensors with a digest are equal: encoding differs, or the steps after the last one")
    return failed + lines


# 2. What it costs


@dataclass
class Training:
    """One method in steps that can be taken a few at a time, through all of its stages."""

    method: str
    args: argparse.Namespace
    session: Any
    scene: Any
    deterministic: bool
    trained: Callable[[str], Any]
    seconds: float = 0.0
    steps: int = 0
    turns: list[float] = field(default_factory=list)

    def order(self) -> Any:
        return one_order_of_sums() if self.deterministic else nullcontext()

    def take_turns(self) -> Iterator[None]:
        """Train `args.turn` steps each time; ends where the training does."""
        from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
        from splatwizard_core.streams import Streams
        from splatwizard_core.training.stage import StageContext
        from splatwizard_core.training.state import TrainingState
        from splatwizard_core.training.trainer import Trainer

        with self.order():
            more = {"deterministic": self.deterministic}
            resolved, method = resolved_method(self.method, self.args, self.session.plugins, **more)
            streams = Streams(resolved.ppl.seed)
            rasterizer = NegotiatedRasterizer(self.session.plugins, device=self.session.device)
        model = None
        for stage in method.stages():
            with self.order():
                if stage.starts_from is not None:
                    model = copy.deepcopy(self.trained(stage.starts_from)).requires_grad_(True).train()
                elif model is None:
                    model = method.create_model(self.scene, streams("init")).to(self.session.device).train()
                context = StageContext(model, self.scene, resolved.ppl, rasterizer, streams, self.trained)
                model = stage.begin(context)
                trainer = Trainer(TrainingState.begin(stage, model, self.scene, resolved.ppl, rasterizer, streams))
            while trainer.state.step < stage.iterations and not trainer.state.stopped:
                before = trainer.state.step
                with self.order():
                    synchronize()
                    began = time.perf_counter()
                    trainer.run(min(before + self.args.turn, stage.iterations), lambda _: None)
                    synchronize()
                taken = time.perf_counter() - began
                self.seconds, self.steps = self.seconds + taken, self.steps + trainer.state.step - before
                self.turns.append(taken / max(trainer.state.step - before, 1))
                yield
            with self.order():
                model = stage.finish(trainer.state.model, self.scene)
        self.model = model


def synchronize() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def resolved_method(method: str, args: argparse.Namespace, plugins: Any, **more: Any) -> tuple[Any, Any]:
    from splatwizard_core.runs.config import parse_set, resolve
    from splatwizard_core.runs.pretrained import make_method

    sets = {**parse_set(assignments(method, args)), "seed": args.seed, **more}
    sets |= {"images": args.images} if args.images else {}
    resolved = resolve(plugins.methods.load(method), args.preset, sets=sets, scene=args.scene, plugins=plugins)
    return resolved, make_method(plugins, resolved)


def starts_from_another(method: str, args: argparse.Namespace, plugins: Any) -> bool:
    return any(stage.starts_from is not None for stage in resolved_method(method, args, plugins)[1].stages())


def time_method(method: str, args: argparse.Namespace) -> None:
    """Print one JSON line: seconds and steps with the key and without, and the median of the ratios of turns."""
    from splatwizard_core.plugins.manager import load_plugins
    from splatwizard_core.runs.session import Session
    from splatwizard_core.scene.images import decode_all, keep_pictures

    session = Session(load_plugins(), torch.device(args.device), lambda line: print(line, file=sys.stderr))
    resolved, _ = resolved_method(method, args, session.plugins)
    scene = session.scene(resolved)
    decode_all(scene.train)
    keep_pictures(scene.train, session.device)
    start: dict[str, Any] = {}

    def trained(name: str) -> Any:
        if name not in start:
            first = Training(name, args, session, scene, False, trained)
            for _ in first.take_turns():
                pass
            start[name] = first.model.eval().requires_grad_(False)
        return start[name]

    with seeded(args.seed):
        both = [Training(method, args, session, scene, asked, trained) for asked in (False, True)]
        for _ in itertools.zip_longest(*(each.take_turns() for each in both)):
            pass
    # The first turns load what is needed.
    ratios = [slow / fast for fast, slow in zip(both[0].turns[2:], both[1].turns[2:], strict=False)]
    rates = [each.steps / each.seconds for each in both]
    print(json.dumps({"rates": rates, "ratio": statistics.median(ratios) if ratios else None}), flush=True)


def timed(method: str, args: argparse.Namespace, gpu: str) -> dict[str, Any]:
    forwarded = [word for word in sys.argv[1:] if word != "--ops"]
    status, output = call([sys.executable, __file__, *forwarded, "--time", method], gpu)
    last = output.strip().splitlines()[-1:] or [""]
    lines = [line for line in output.splitlines() if line.startswith('{"rates"')]
    return json.loads(lines[-1]) if status == 0 and lines else {"error": last[0]}


# Operations


def operations(device: str) -> dict[str, Callable[[], list[Tensor]]]:
    """Name -> () -> tensors whose bits must be equal each time; sizes of a real step."""
    from sw_anchors.fast.fixed_step import bernoulli_rows, sample_of
    from sw_anchors.fast.networks import network_outputs
    from sw_anchors.fast.rows import add_rows
    from sw_anchors.fast.seen_rows import ExpectedRows
    from sw_anchors.fast.spawn import fits, visible_gaussians
    from sw_compact3dgs.seen_rows import SeenRows
    from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene

    from splatwizard_core.api import RasterOptions, photometric_loss
    from sw_cat_3dgs.fast import plane_bits, plane_sites
    from sw_cat_3dgs.spatial_ar import SpatialAr
    from sw_cat_3dgs.triplane import Triplane
    from sw_codecs.codebooks.kmeans import kmeans
    from sw_codecs.context.hash_grid import HashGrid
    from sw_codecs.context.two_layers import two_layers
    from sw_codecs.quantizers.residual_quantizer import ResidualVectorQuantizer
    from sw_hac.mixed_grid import MixedHashGrid
    from sw_rasterizers.standard import StandardRasterizer
    from sw_rasterizers.surfel import SurfelRasterizer

    draw = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw).to(device)

    def drawn(name: str, rasterizer: Any, maps: dict[str, Any]) -> Callable[[], list[Tensor]]:
        size = {"n": 20_000, "width": 400, "height": 300, "spread": 2.0, "scale": (0.01, 0.15)}
        case = RasterCase("many", geometry=name, **size)  # type: ignore[arg-type]
        g, cam = draw_scene(case, 3, torch.float32)
        g = cast_inputs(g, torch.float32, device)
        leaves = [getattr(g, each).requires_grad_() for each in ("means", "opacities", "scales", "quats")]
        slopes = normal(3, case.height, case.width)

        def render() -> list[Tensor]:
            result = rasterizer.render(g, cam, RasterOptions(grad2d=True, alpha=True, **maps))
            total = (result.image * slopes).sum() + result.alpha.square().sum()
            if maps:
                total = total + result.normals.square().sum() + result.distortion.sum()
                total = total + sum(each.square().mean() for each in result.depth.values())
            return [result.image.detach(), *torch.autograd.grad(total, leaves), result.grad2d.value]

        return render

    grid = HashGrid.real_grid(
        3, levels=16, features=2, log2_size=19, coarsest=16, finest=16 * 1.447**15, generator=draw
    ).to(device)
    signs = MixedHashGrid(generator=draw).to(device)
    few, many = torch.rand(60_000, 3, generator=draw).to(device), torch.rand(300_000, 3, generator=draw).to(device)
    grid_slopes, sign_slopes = normal(len(many), grid.width), normal(len(few), signs.width)
    learned = list(Triplane(64, 72, (1, 2), generator=draw).to(device).planes)
    sites = plane_sites.sites_of(learned, torch.randint(0, 1 << 16, (60_000, 3), generator=draw).to(device))
    plane_slopes = normal(60_000, 2 * 3 * 72)
    arms = [SpatialAr(draw).to(device) for _ in range(3)]
    planes = [(normal(3, 72, n, n) * 3).requires_grad_() for n in (64, 128)]
    k = 10
    anchors = [normal(60_000, *size).requires_grad_() for size in ((k,), (7 * k,), (3 * k,), (3,), (k, 3), (6,))]
    masks = (torch.rand(60_000, k, generator=draw) > 0.3).float().to(device).requires_grad_()
    networks = tuple(two_layers(54, 50, out * k, draw).to(device) for out in (1, 7, 3))
    features, centre = normal(60_000, 50).requires_grad_(), torch.zeros(3, device=device)
    rows = torch.randperm(200_000, generator=draw)[:60_000].to(device)
    seen, order = (torch.rand(200_000, generator=draw) < 0.3).to(device), torch.randperm(200_000, generator=draw)
    uniform = torch.rand(60_000, generator=draw).to(device)
    shapes, vq = normal(200_000, 3), ResidualVectorQuantizer(64, 6, dim=3).to(device)
    vq.fit(shapes[:20_000], generator=torch.Generator().manual_seed(0), iterations=3)
    assert vq.codebooks is not None
    colors = normal(80_000, 27)
    picture, truth = torch.rand(3, 800, 800, device=device, requires_grad=True), torch.rand(3, 800, 800, device=device)

    def of_planes() -> list[Tensor]:
        bits = plane_bits.plane_bits(arms, planes)
        learning = [*planes, *(p for arm in arms for p in arm.parameters())]
        return [bits.detach(), *torch.autograd.grad(bits, learning)]

    def spawned() -> list[Tensor]:
        assert fits(*anchors, masks)  # loads the kernels
        found = visible_gaussians(*anchors, masks)
        parts = (found.means, found.opacities, found.scales, found.quats, found.colors)
        return list(torch.autograd.grad(sum(part.pow(3).sum() for part in parts), [*anchors, masks]))

    def of_networks() -> list[Tensor]:
        outputs = network_outputs(centre, anchors[3].detach(), features, networks)
        learning = [features, *(p for network in networks for p in network.parameters())]
        return [outputs[0].detach(), *torch.autograd.grad(sum(each.square().sum() for each in outputs), learning)]

    def added() -> list[Tensor]:
        into = [torch.zeros(200_000, device=device), torch.zeros(200_000, 5, device=device)]
        add_rows(rows, [features.detach()[:, 0].contiguous(), features.detach()[:, :5].contiguous()], into)
        return into

    def expected() -> list[Tensor]:
        found = ExpectedRows(order.to(device), seen, 70_000)
        return [found.loaded, *sample_of(uniform, (uniform >= 0).float(), 0.05), *bernoulli_rows(uniform, 10**6, 0.05)]

    def looked_up(grid: Any, x: Tensor, slopes: Tensor) -> Callable[[], list[Tensor]]:
        return lambda: list(torch.autograd.grad((grid(x) * slopes).sum(), list(grid.parameters())))

    def taken() -> list[Tensor]:
        table = features.detach().clone().requires_grad_()
        seen_rows = SeenRows(uniform < 0.3)
        return list(torch.autograd.grad(seen_rows.put(seen_rows.take(table)).square().sum(), [table]))

    def loss() -> list[Tensor]:
        found = photometric_loss(picture, truth, lambda_dssim=0.2).total
        return [found.detach(), *torch.autograd.grad(found, [picture])]

    maps = {"depth": frozenset({"expected", "median"}), "normals": True, "distortion": True}
    return {
        "rasterizer standard": drawn("scales", StandardRasterizer(), {}),
        "rasterizer 2dgs": drawn("surfels", SurfelRasterizer(), {}),
        "rasterizer 2dgs, maps": drawn("surfels", SurfelRasterizer(), maps),
        "hash grid (Compact3DGS)": looked_up(grid, many, grid_slopes),
        "grids of signs (HAC)": looked_up(signs, few, sign_slopes),
        "triplane (CAT-3DGS)": lambda: list(
            torch.autograd.grad((plane_sites.sample(learned, sites, rounded=True) * plane_slopes).sum(), learned)
        ),
        "bits of planes (CAT-3DGS)": of_planes,
        "Gaussians of anchors": spawned,
        "networks of anchors": of_networks,
        "rows added": added,
        "rows expected, sampled": expected,
        "seen rows (Compact3DGS)": taken,
        "residual VQ": lambda: list(torch.autograd.grad(vq.codebook_loss(shapes), [vq.codebooks])),
        "k-means": lambda: [
            kmeans(
                colors, torch.ones(len(colors), device=device), size=1024, iterations=3,
                generator=torch.Generator().manual_seed(0),
            )[0]
        ],
        "loss": loss,
    }  # fmt: skip


def run_operations(device: str) -> bool:
    """Print a line for each operation; returns whether all have equal bits with the key."""
    fine = True
    print(
        f"{'operation':27} {'with the key':>13} {'without':>9} {'apart':>9} {'ms with':>9} {'without':>9} {'ratio':>6}"
    )
    for name, operation in operations(device).items():
        found: dict[bool, list[list[Tensor]]] = {}
        milliseconds: dict[bool, float] = {}
        try:
            for asked in (False, True):
                with one_order_of_sums() if asked else nullcontext():
                    operation()
                    synchronize()
                    began = time.perf_counter()
                    found[asked] = [operation() for _ in range(REPEATS)]
                    synchronize()
                    milliseconds[asked] = 1e3 * (time.perf_counter() - began) / REPEATS
        except Exception as error:
            print(f"{name:27} FAILED: {type(error).__name__}: {str(error).splitlines()[0][:150]}", flush=True)
            fine = False
            continue
        equal = {asked: all(same(each, runs[0]) for each in runs[1:]) for asked, runs in found.items()}
        pairs = zip(found[True][0], found[False][0], strict=True)
        apart = max((float((a.double() - b.double()).norm() / b.double().norm().clamp_min(1e-30)) for a, b in pairs))
        fine = fine and equal[True]
        says = {True: "equal", False: "differ"}
        print(
            f"{name:27} {says[equal[True]]:>13} {says[equal[False]]:>9} {apart:9.1e} {milliseconds[True]:9.3f} "
            f"{milliseconds[False]:9.3f} {milliseconds[True] / milliseconds[False]:6.2f}",
            flush=True,
        )
    return fine


def same(found: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(found, other, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", metavar="SCENE", help=FORMS)
    parser.add_argument("--ops", action="store_true", help="operations alone")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--iterations", type=int, default=1500, help="0: those of the preset")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--control", action="store_true", help="as many runs without the key, which may differ")
    parser.add_argument("--every", type=int, default=250, help="steps between digests of the model's tensors")
    parser.add_argument("--gpus", default="", help="numbers, such as 0,1; default: the first")
    parser.add_argument("--jobs", type=int, default=4, help="trainings at once on each GPU")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of each")
    parser.add_argument("--turn", type=int, default=50, help="steps of a turn")
    parser.add_argument("--no-timing", action="store_true")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, help="where runs stay; default: a folder that goes again")
    parser.add_argument("--time", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.ops:
        sys.exit(0 if run_operations(args.device) else 1)
    from splatwizard_core.plugins.manager import load_plugins

    plugins = load_plugins()
    args.scene, args.images = split_scene(args.scene, plugins)
    args.starting = []
    args.starting = [m for m in (args.time or args.methods).split(",") if starts_from_another(m, args, plugins)]
    if args.time:
        time_method(args.time, args)
        return
    methods, names = args.methods.split(","), args.gpus.split(",")
    gpus: queue.Queue[str] = queue.Queue()
    for name in names * args.jobs:
        gpus.put(name)
    with tempfile.TemporaryDirectory() as temporary:
        out = args.out or Path(temporary)
        kinds = (True, False) if args.control else (True,)
        wanted = [
            Run(method, number, asked, out / f"{method}-{number}{'' if asked else '-control'}")
            for number in range(args.runs)
            for method in methods
            for asked in kinds
        ]
        with ThreadPoolExecutor(len(names) * args.jobs) as pool:
            made = list(pool.map(lambda run: make(run, args, gpus), wanted))
        print(f"{args.scene} {args.images}, {args.iterations or 'all'} steps, seed {args.seed}, {args.runs} runs")
        print(f"{'method':14} {'files':>12} {'bytes':>11} {'digest':>13}")
        equal = True
        for method, asked in itertools.product(methods, kinds):
            runs = [run for run in made if run.method == method and run.deterministic == asked]
            fine = len({run.digest for run in runs}) == 1 and runs[0].digest is not None
            equal = equal and (fine or not asked)
            name = method if asked else "  without key"
            print(
                f"{name:14} {'equal' if fine else 'DIFFER':>12} {runs[0].size:11,} {(runs[0].digest or '-')[:12]:>13}"
            )
            for line in told(runs) if not fine else []:
                print(f"    {line}")
        sys.stdout.flush()
    if not args.no_timing:
        print(f"{'method':14} {'steps/s without':>15} {'with the key':>13} {'time of a step':>15}")
        for method in methods:
            found = timed(method, args, names[0])
            if "error" in found:
                print(f"{method:14} failed: {found['error']}", flush=True)
            else:
                fast, slow = found["rates"]
                print(f"{method:14} {fast:15.1f} {slow:13.1f} {found['ratio']:15.2f}", flush=True)
    sys.exit(0 if equal else 1)


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        train_with_digests()
    else:
        main()
