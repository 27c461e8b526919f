"""Plugins that change the process, or return what is no result: for tests/test_reckless_neighbours.py."""

from __future__ import annotations

from bad_neighbours import DATASET, hook, metric

IMPORTS = {
    "sw-chdir": ("import os\nos.chdir('/')\n", "changes the working folder: it is put back"),
    "sw-child": ("import subprocess\nsubprocess.run(['echo', 'rubbish'])\n", "writes to file descriptor 1"),
    "sw-writes": ("import os\nos.write(1, b'rubbish')\n", "writes to file descriptor 1"),
    "sw-closes": ("import sys\nsys.stdout.close()\nsys.__stderr__.close()\n", "closes standard output and error"),
    "sw-closes-fd": ("import os\nos.close(1)\nos.close(2)\n", "closes standard output and error"),
    "sw-env": (
        "import os\nos.environ['HOME'] = os.environ['CUDA_VISIBLE_DEVICES'] = ''\n",
        "CUDA_VISIBLE_DEVICES, HOME",
    ),
    "sw-filters": ("import warnings\nwarnings.simplefilter('error')\n", "changes the filters of all warnings"),
    "sw-seeds": ("import random\nrandom.seed(0)\n", "changes the random numbers of Python"),
    "sw-recursion": ("import sys\nsys.setrecursionlimit(200)\n", "changes the limit of recursion"),
    "sw-ctrl-c": ("import signal\nsignal.signal(signal.SIGINT, lambda *_: None)\n", "changes who answers SIGINT"),
    "sw-silences": ("import logging\nlogging.disable(logging.CRITICAL)\n", "changes how much is logged"),
    "sw-handlers": ("import logging\nlogging.root.handlers.clear()\n", "changes who writes what is logged"),
    "sw-thread": (
        "import threading, time\nthreading.Thread(target=time.sleep, args=(3600,), name='their thread').start()\n",
        "starts a thread (their thread)",
    ),
}
"""Distribution -> its plugin module, which works, and what the line about it says."""

LATE = "registering takes more than 3 s"
BROKEN = {
    "sw-sleeps": ("import time\ntime.sleep(3600)\n", LATE),
    "sw-hook-waits": (hook("register_metrics", "import threading", "threading.Event().wait()"), LATE),
    "sw-kbd": ("raise KeyboardInterrupt\n", "it raises KeyboardInterrupt"),
    "sw-generator-exit": ("raise GeneratorExit('odd')\n", "it raises GeneratorExit odd"),
    "sw-leaves": ("import os\nos._exit(0)\n", "os._exit(0)"),
    "sw-hook-leaves": (
        hook("register_metrics", "import os", "os._exit(0)"),
        "register_metrics: ProcessExit: os._exit(0)",
    ),
}
"""Distribution -> its plugin module, and why it is broken."""

TARGETS = {
    "sw-no-grad": ("torch.set_grad_enabled(False)", "changes gradients"),
    "sw-inference": ("left_on = torch.inference_mode()\nleft_on.__enter__()", "changes the inference mode of torch"),
    "sw-dtype": ("torch.set_default_dtype(torch.float64)", "changes the default dtype of torch"),
    "sw-device": ("torch.set_default_device('meta')", "changes the default device of torch"),
    "sw-threads": ("torch.set_num_threads(torch.get_num_threads() + 1)", "changes the number of threads of torch"),
    "sw-deterministic": ("torch.use_deterministic_algorithms(True)", "changes deterministic algorithms"),
    "sw-cudnn": ("torch.backends.cudnn.deterministic = True", "changes cudnn.deterministic"),
}
"""Distribution -> what the module of its metric does when it is imported, and what the line about it says."""

METRICS = {
    "sw-value-leaves": ("__import__('os')._exit(0)", "os._exit(0)"),
    "sw-value-kbd": ("raise KeyboardInterrupt", "it raises KeyboardInterrupt"),
}
"""Distribution -> body of a metric that has no value, and why."""

CHANGING = {
    "sw-value-no-grad": ("import torch; torch.set_grad_enabled(True); return 1.0", "changes gradients"),
    "sw-value-chdir": ("import os; os.chdir('/'); return 1.0", "changes the working folder"),
}
"""Distribution -> body of a metric that has a value, and what the line about it says."""

FAMILY = """
    def load(self, path, options):
        {load}
"""
FAMILIES = {
    "sw-loads-none": ("return None", "load() gives NoneType for Scene"),
    "sw-loads-raises": ("raise KeyError('pose')", "KeyError: 'pose'"),
    "sw-loads-leaves": ("import os; os._exit(0)", "os._exit(0)"),
    "sw-loads-parts": (
        "from splatwizard_core.api import Protocol, Scene; return Scene('s', None, [], None, Protocol('d'))",
        "train and test are no lists of View",
    ),
}
"""Distribution -> body of `load` of a family that claims every folder, and what the line about it says."""

RASTERIZER = """
@hookimpl
def register_rasterizers(registry):
    features = ["BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COLORS_ND", "SPLIT_SH", "INDEXED_SH"]
    registry.add("{name}", "{module}:Made", summary="", devices=["cpu"], features=features, speed=1)

def Made():
    import torch
    from splatwizard_core.api import RasterizerInfo
    from sw_reference.rasterizer import ReferenceRasterizer

    class Theirs(ReferenceRasterizer):
        info = RasterizerInfo.declared(register_rasterizers, "{name}")

        def render(self, g, cam, opt):
            found = super().render(g, cam, opt)
            {body}
            return found

    return Theirs()
"""
RASTERIZERS = {
    "sw-small": ("found.image = found.image[:, :7, :9]", "image is (3, 7, 9), must be (3, 48, 64)"),
    "sw-nan": ("found.image = found.image * float('nan')", "its picture holds values that are not finite"),
    "sw-array": ("found.image = found.image.detach().numpy()", "image is ndarray, must be (3, 48, 64)"),
    "sw-nothing": ("found = None", "it returns NoneType for RenderResult"),
    "sw-radii": ("found.radii = found.radii[:3]", "radii is (3,), must be ("),
}
"""Distribution -> what a rasterizer makes of a picture, and what the line about it says."""
TRAINED = {
    "sw-detached": ("found.image = found.image.detach()", "its picture has no gradient"),
    "sw-switches": ("torch.set_grad_enabled(False)", "it switches gradients off"),
}
"""The same, of one that spoils a training."""


def rasterizer(name: str, body: str) -> str:
    return RASTERIZER.format(name=name.removeprefix("sw-"), module=name.replace("-", "_"), body=body)


def family(name: str, load: str) -> str:
    detect = DATASET.format(name=name.removeprefix("sw-"), module=name.replace("-", "_"), body="return 1.0")
    return detect + FAMILY.format(load=load)


def lazy_metric(name: str) -> str:
    return metric(name.removeprefix("sw-"), f"{name.replace('-', '_')}_target")
