"""`python -m sw_doctor.probe`: everything that needs torch, tried in this process.

Kernels are loaded and pictures drawn here, so that a crash takes this process and not the one that reports it. Nothing
is compiled.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import pkgutil
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.api import PluginError, PluginManager, SplatwizardError
from splatwizard_core.tooling import (
    Check,
    Entry,
    PluginInfo,
    State,
    load_plugins,
)
from splatwizard_native import NativeBuildError, NativeModule
from sw_doctor.child import Step, serve
from sw_doctor.declared_modules import declared_modules
from sw_doctor.remedies import remedy_of
from sw_doctor.text import OF, SLOWLY, one_line

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

METHOD, SCENES, RASTERIZERS = "sw-3dgs", "sw-datasets", "sw-rasterizers"
"""Packages that `sw run` needs besides the core: what it trains, on which scene, drawn by what."""
MOST_FOLDERS = 500  # a data folder may be a file server; who has more scenes sees how many were looked at


def steps() -> Iterator[tuple[str, Step]]:
    """Yield (name, step) in order; the later ones need torch, and without it there are none."""
    yield "torch", check_torch
    if not _imports("torch"):
        return
    yield "CUDA", check_cuda
    try:
        plugins = load_plugins()
    except PluginError:  # $SW_PLUGINS names one that is not there: the asking process says so
        return
    theirs = {t for registry in plugins.registries.values() for e in registry if e.foreign for t in _native(e)}
    targets = declared_modules(plugins)
    for target in [t for t in targets if t not in theirs]:
        yield target, lambda target=target: check_kernels(target)  # type: ignore[misc]
    yield "sw run", lambda: [check_main_job(plugins)]
    yield "rasterizers", lambda: check_rasterizers(plugins)
    yield "entries", lambda: check_entries(plugins)
    # From here on strangers' code is run as well, and may end this process: each step names whose.
    for info in (each for each in plugins.plugins if each.foreign):
        yield f"entries{OF}{info.distribution}", lambda info=info: check_theirs(plugins, info)  # type: ignore[misc]
    for target in [t for t in targets if t in theirs]:
        yield target, lambda target=target: check_kernels(target)  # type: ignore[misc]
    yield "scenes", lambda: [check_scenes(plugins)]


def _native(entry: Entry) -> list[str]:
    """Targets of the native modules that an entry declares."""
    declared = entry.declared.get("native") or ()
    return [declared] if isinstance(declared, str) else list(declared)


def _imports(module: str) -> bool:
    try:
        importlib.import_module(module)
    except Exception:
        return False
    return True


def check_torch() -> list[Check]:
    """Import it and multiply two matrices."""
    again = "pip install --force-reinstall torch -c constraints.txt"
    try:
        import torch

        product = torch.ones(8, 8) @ torch.ones(8, 8)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "torch":
            return [Check("torch", "torch", "missing", "not installed", "pip install torch -c constraints.txt", True)]
        why = one_line(f"does not import: {type(error).__name__}: {error}")
        return [Check("torch", "torch", "broken", why, again, True)]
    if float(product.sum()) != 8.0**3:
        return [Check("torch", "torch", "broken", "multiplies two matrices wrongly", again, True)]
    version = str(torch.__version__)
    facts = {"version": version, "cuda": torch.version.cuda, "threads": torch.get_num_threads()}
    return [Check("torch", "torch", "ok", f"{version}, {torch.get_num_threads()} threads", None, True, facts)]


def check_cuda() -> list[Check]:
    """Add two numbers on every GPU, or say why there is none."""
    import torch

    built, driver = torch.version.cuda, nvidia_driver()
    if built is None and driver is None:
        return [_cuda("missing", "no NVIDIA driver here, and this torch has no CUDA: the CPU computes")]
    if built is None:
        public = str(torch.__version__).partition("+")[0]
        detail = f"there is an NVIDIA driver ({driver}), but torch {torch.__version__} is built without CUDA"
        return [_cuda("broken", detail, f"pip install --force-reinstall torch=={public}")]
    if driver is None:
        detail = f"torch is built for CUDA {built}, but there is no NVIDIA driver: the CPU computes"
        return [_cuda("missing", detail, "install the NVIDIA driver, if there is such a GPU")]
    try:
        names = _try_gpus()
    except Exception as error:
        mend = f"bring driver ({driver}) and CUDA {built} together: `nvidia-smi` shows what the driver can"
        return [_cuda("broken", one_line(error), mend)]
    if not names:
        return [_cuda("missing", "the driver shows no GPU", "see `nvidia-smi`, and $CUDA_VISIBLE_DEVICES if it is set")]
    shown = "; ".join(f"{names.count(name)} x {name}" for name in dict.fromkeys(names))
    return [Check("torch", "CUDA", "ok", f"{built}, {shown}", facts={"gpus": names, "driver": driver})]


def _cuda(state: State, detail: str, mend: str | None = None) -> Check:
    return Check("torch", "CUDA", state, detail, mend)


def _try_gpus() -> list[str]:
    """Name, memory and capability of every GPU that adds rightly. Raises what torch raises, or RuntimeError."""
    import torch

    torch.cuda.init()  # type: ignore[no-untyped-call]
    names = []
    for index in range(torch.cuda.device_count()):
        if (torch.ones(1, device=f"cuda:{index}") + 1).item() != 2:
            raise RuntimeError(f"GPU {index} adds wrongly")
        gpu = torch.cuda.get_device_properties(index)
        names.append(f"{gpu.name}, {gpu.total_memory / 1e9:,.0f} GB, compute capability {gpu.major}.{gpu.minor}")
    return names


def nvidia_driver() -> str | None:
    """Version of the kernel's NVIDIA module; None if it is not loaded."""
    with contextlib.suppress(OSError, IndexError):
        line = Path("/proc/driver/nvidia/version").read_text().splitlines()[0]
        return next((word for word in line.split() if word[0].isdigit() and "." in word), line.strip())
    return None


def check_kernels(target: str) -> list[Check]:
    """Load a native module, and its kernels of CUDA where torch has it, if they are built; it compiles nothing."""
    import torch

    try:
        module = pkgutil.resolve_name(target)
    except (Exception, SystemExit) as error:
        why = one_line(f"cannot be imported: {type(error).__name__}: {error}")
        return [Check("kernels", target, "broken", why, "install the package again")]
    if not isinstance(module, NativeModule):
        detail = f"it is not a NativeModule but {type(module).__name__}"
        return [Check("kernels", target, "broken", detail, "install the package again")]
    of_cuda = module.cuda if torch.version.cuda is not None else None
    return [_check_module(each) for each in (module, of_cuda) if each is not None]


def _check_module(module: NativeModule) -> Check:
    build = "sw build-kernels"
    try:
        facts = module.state()
        loaded = module.load_built()
    except NativeBuildError as error:
        switched_off = "SPLATWIZARD_NATIVE" in str(error)
        mend = "unset SPLATWIZARD_NATIVE" if switched_off else f"{build} --force"
        return Check("kernels", module.name, "missing" if switched_off else "broken", one_line(error), mend)
    if loaded:
        detail = f"{facts['state']} for {facts['target']}, loaded"
        return Check("kernels", module.name, "ok", detail, facts=facts)
    if facts["state"] == "damaged":
        detail = "the build in the cache is damaged"
        return Check("kernels", module.name, "broken", detail, f"{build} --force", facts=facts)
    reason = module.available()
    when = "compiled when first used" if reason is None else one_line(reason)
    detail = f"reference: not built; {when}. Without: {module.without}"
    return Check("kernels", module.name, "missing", detail, build, facts=facts)


def check_entries(plugins: PluginManager) -> list[Check]:
    """Import every lazy target of every plugin of ours."""
    ours = [entry for registry in plugins.registries.values() for entry in registry if not entry.foreign]
    broken = _broken_targets(ours)
    loaded = len(ours) - len(broken)
    return [Check("plugins", "entries", "ok", f"{loaded} methods, rasterizers, coders, ... load"), *broken]


def check_theirs(plugins: PluginManager, info: PluginInfo) -> list[Check]:
    """Import every lazy target of a stranger's plugin, and let its rasterizers draw."""
    entries = plugins.provided_by(info)
    broken = _broken_targets(entries)
    failed = {check.name for check in broken}
    drawing = [e for e in entries if e.kind == "rasterizer" and f"{e.kind} {e.name}" not in failed]
    return [*broken, *(_check_rasterizer(entry, plugins) for entry in drawing)]


def _broken_targets(entries: Iterable[Entry]) -> list[Check]:
    """Return one finding for each entry whose target cannot be imported."""
    checks = []
    for entry in entries:
        try:
            entry.load()
        except PluginError as error:
            mend = remedy_of(entry.distribution, str(error), foreign=entry.foreign)
            checks.append(Check("plugins", f"{entry.kind} {entry.name}", "broken", one_line(error), mend))
    return checks


def check_rasterizers(plugins: PluginManager) -> list[Check]:
    """Let every rasterizer of ours that can run here without a compiler draw a small picture, forward and backward."""
    if not len(plugins.rasterizers):
        return [Check("rasterizers", "none", "missing", "none is installed", _how_to_get([RASTERIZERS]))]
    return [_check_rasterizer(entry, plugins) for entry in plugins.rasterizers if not entry.foreign]


def _check_rasterizer(entry: Entry, plugins: PluginManager) -> Check:
    import torch

    from splatwizard_core.api import RasterizerInfo
    from splatwizard_core.tooling import NegotiatedRasterizer

    try:
        info = RasterizerInfo.from_entry(entry)
    except PluginError as error:
        mend = remedy_of(entry.distribution, str(error), foreign=entry.foreign)
        return Check("rasterizers", entry.name, "broken", one_line(error), mend)
    device = "cpu" if "cpu" in info.devices else "cuda"
    where = ", ".join(sorted(info.devices))
    if device == "cuda" and not torch.cuda.is_available():
        return Check("rasterizers", entry.name, "missing", f"runs on {where} only, and there is none")
    lacking = _lacking_kernels(entry)
    if lacking is not None:
        detail = f"its kernels '{lacking.name}' are not loaded"
        return Check("rasterizers", entry.name, lacking.state, detail, lacking.mend)
    try:
        why = info.obstacle(device)
        if why is not None:
            what, mend = _with_command_apart(why)
            return Check("rasterizers", entry.name, "missing", one_line(what), mend)
        entry.load()()  # for its own error: the choice below would tell of all others
        alone = [each.name for each in plugins.rasterizers if each is not entry]
        rasterizer = NegotiatedRasterizer(plugins, device=device, prefer=[entry.name], forbid=alone)
        _draw(rasterizer, device, backward="BACKWARD" in info.features, axes=2 if "SURFEL" in info.needs else 3)
    except (Exception, SystemExit) as error:
        mend = remedy_of(entry.distribution, str(error), foreign=entry.foreign)
        return Check("rasterizers", entry.name, "broken", one_line(f"{type(error).__name__}: {error}"), mend)
    return Check("rasterizers", entry.name, "ok", f"drew a test picture on {device} (runs on {where})")


def _with_command_apart(why: str) -> tuple[str, str | None]:
    """`gsplat is not installed (pip install X)` as `gsplat is not installed` and `pip install X`."""
    found = re.fullmatch(r"(.*\S) \((pip install [^()]+)\)", why)
    return (why, None) if found is None else (found[1], found[2])


def _lacking_kernels(entry: Entry) -> Check | None:
    """Finding about a native module that this rasterizer needs and that did not load; None if all did."""
    checks = [check_kernels(target)[0] for target in _native(entry)]
    return next((check for check in checks if check.state != "ok"), None)


def _draw(rasterizer: Rasterizer, device: str, *, backward: bool, axes: int = 3) -> None:
    """Sixteen splats (two axes: surfels) on 32 x 24 pixels. Raises if the picture is empty, a gradient not finite."""
    import torch

    from splatwizard_core.api import Camera, GaussianInputs, RasterOptions

    generator = torch.Generator().manual_seed(0)
    means = torch.rand(16, 3, generator=generator) - 0.5
    means.requires_grad_(backward)
    splats = GaussianInputs(
        means=means.to(device),
        opacities=torch.full((16,), 0.8, device=device),
        scales=torch.full((16, axes), 0.1, device=device),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device).repeat(16, 1),
        colors=torch.ones(16, 3, device=device),
    )
    camera = Camera(
        32, 24, 30.0, 30.0, 16.0, 12.0, torch.eye(3, device=device), torch.tensor([0.0, 0, 2], device=device)
    )
    with torch.set_grad_enabled(backward):
        image = rasterizer.render(splats, camera, RasterOptions()).image
    if not bool(torch.isfinite(image).all()) or float(image.detach().max()) < 0.5:
        raise SplatwizardError("drew a wrong picture of sixteen white splats")
    if backward:
        image.square().sum().backward()
        if means.grad is None or not bool(torch.isfinite(means.grad).all()) or not bool(means.grad.any()):
            raise SplatwizardError("gave wrong gradients of sixteen white splats")


def check_scenes(plugins: PluginManager) -> Check:
    """Count the scenes below $SPLATWIZARD_DATA, recognised as `--scene dataset/scene` would."""
    root = os.environ.get("SPLATWIZARD_DATA")
    if not root:
        mend = "export SPLATWIZARD_DATA=/path/to/datasets  (the demo scene needs none)"
        return Check("data", "SPLATWIZARD_DATA", "missing", "not set: dataset/scene names are not looked up", mend)
    folder = Path(root).expanduser()
    try:
        collections = sorted(p for p in folder.iterdir() if p.is_dir())
        inside = [p for c in collections for p in sorted(c.iterdir()) if p.is_dir()][: MOST_FOLDERS + 1]
    except OSError as error:
        mend = "set SPLATWIZARD_DATA to the folder that holds the data sets"
        return Check("data", "SPLATWIZARD_DATA", "broken", f"{error.filename}: {error.strerror}", mend)
    if not len(plugins.datasets):
        return Check("data", "SPLATWIZARD_DATA", "missing", "no loader is installed", _how_to_get([SCENES]))
    found: dict[str, int] = {}
    for path in inside[:MOST_FOLDERS]:
        if any(_detects(entry, path) for entry in plugins.datasets):
            found[path.parent.name] = found.get(path.parent.name, 0) + 1
    more = f" (of the first {MOST_FOLDERS} folders)" if len(inside) > MOST_FOLDERS else ""
    if not found:
        mend = "put scenes at $SPLATWIZARD_DATA/dataset/scene"
        return Check("data", "SPLATWIZARD_DATA", "missing", f"{folder}: no scene is in it{more}", mend)
    shown = ", ".join(f"{name} {count}" for name, count in found.items())
    return Check("data", "SPLATWIZARD_DATA", "ok", f"{folder}: {shown}{more}", facts={"scenes": found})


def _detects(entry: Entry, path: Path) -> bool:
    """Whether a family reads this folder; one that fails does not."""
    try:
        target = entry.load()
        return bool((target() if isinstance(target, type) else target).detect(path) > 0)
    except (Exception, SystemExit):
        return False


def check_main_job(plugins: PluginManager) -> Check:
    """Resolve `sw run` of the default method on the default scene, and draw as its trainer would with what is built."""
    from splatwizard_core.tooling import NegotiatedRasterizer, choose_device, resolve

    method, scene = plugins.methods.default, plugins.datasets.default
    if method is None or scene is None or not len(plugins.rasterizers):
        parts = (("a method", METHOD, method), ("a scene", SCENES, scene),
                 ("a rasterizer", RASTERIZERS, plugins.rasterizers.names))  # fmt: skip
        absent = {what: package for what, package, found in parts if not found}
        detail, mend = f"not installed: {', '.join(absent)}", _how_to_get(absent.values())
        return Check("main job", "sw run", "broken", detail, mend, needed=True)
    name = f"sw run --method {method} --scene {scene}"
    try:
        resolved = resolve(plugins.methods.load(method), scene=scene)
        plugins.datasets.load(scene)
        device = choose_device(resolved.ppl.device, plugins)
        ours = [entry for entry in plugins.rasterizers if not entry.foreign]
        lacking = {e.name: check for e in ours if (check := _lacking_kernels(e)) is not None}
        rasterizer = NegotiatedRasterizer(plugins, device=device, forbid=lacking)
        _draw(rasterizer, str(device), backward=True)
    except (Exception, SystemExit) as error:
        told = isinstance(error, (SplatwizardError, NativeBuildError))
        why = str(error) if told else f"{type(error).__name__}: {error}"
        return Check("main job", name, "broken", one_line(why), None, needed=True)
    drawn_by = next(iter(rasterizer.choices.values()))
    fast = plugins.rasterizers.entry(drawn_by).declared.get("speed", 0) > 0
    compiled_first = [] if fast else [n for n, c in lacking.items() if c.mend is not None and "build-kernels" in c.mend]
    facts = {"device": str(device), "rasterizer": drawn_by, "compiled_first": compiled_first}
    if compiled_first:
        detail = f"on {device}; the kernels of {' and '.join(compiled_first)} are compiled first"
        return Check("main job", name, "ok", detail, None, True, facts)
    if fast:
        return Check("main job", name, "ok", f"on {device}, drawn by '{drawn_by}'", None, True, facts)
    mend = next((c.mend for c in lacking.values() if c.mend), _how_to_get([RASTERIZERS]))
    return Check("main job", name, "ok", f"on {device}, but {SLOWLY}", mend, True, facts)


def _how_to_get(distributions: Iterable[str]) -> str:
    return f"pip install {' '.join(distributions)}" if os.environ.get("SW_PLUGINS") is None else "unset SW_PLUGINS"


if __name__ == "__main__":
    logging.disable(logging.WARNING)  # what negotiation warns of is in the checks
    serve(steps())
