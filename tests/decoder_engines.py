"""The WebAssembly decoder in wasmtime, Node and Chromium: files in, the hash or the reason for refusing each out."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import sw_view
from headless_chromium import WEBGL, Chromium, find_chromium
from sw_view.coded_file import module_of

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import decode_model

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
FOLDER = Path(sw_view.__file__).parent / "splatwizard-decoder"
SCRIPT = ROOT / "plugins" / "sw-view" / "tests" / "decode_files.mjs"

Told = tuple[str | None, str | None]
"""A hash, or a reason."""


def in_python(data: bytes, name: str = "file") -> Told:
    """Hash or reason of the Python decoder."""
    try:
        return decode_model(ContainerReader(data, name), load_plugins()).parameter_hash(), None
    except BitstreamError as error:
        return None, str(error).removeprefix(f"{name}: ")


def module_for(data: bytes) -> str:
    """The module that knows a file, also one that is damaged behind its header; any tells what is wrong before that."""
    length = int.from_bytes(data[6:10], "little")
    try:
        header = json.loads(data[10 : 10 + length])
        return module_of(SimpleNamespace(method=header["method"], static=header["static"]))
    except (ValueError, KeyError, TypeError):
        return "decoder.wasm"


class Wasmtime:
    """The modules in wasmtime; an instance a file."""

    def __init__(self) -> None:
        import wasmtime

        self.api, self.engine = wasmtime, wasmtime.Engine()
        self.modules = {path.name: wasmtime.Module.from_file(self.engine, str(path)) for path in FOLDER.glob("*.wasm")}
        self.tables = (FOLDER / "exact_tables.zlib").read_bytes()

    def told(self, data: bytes, memory: int = -1, packets: int = 0, then: Sequence[int] = ()) -> Told:
        """Hash or reason; `memory` is the most bytes that the instance may have, and `then` packets to go on to."""
        store = self.api.Store(self.engine)
        store.set_limits(memory_size=memory)
        exports = self.api.Instance(store, self.modules[module_for(data)], []).exports(store)
        exports["_initialize"](store)

        def text(at: int) -> str:
            return bytes(exports["memory"].read(store, at, at + 1024)).partition(b"\0")[0].decode()

        try:
            exports["memory"].write(store, data, exports["swz_input"](store, len(data)))
            exports["memory"].write(store, self.tables, exports["swz_tables"](store, len(self.tables)))
            exports["swz_decode"](store, packets)
            for further in then:
                assert exports["swz_go_on"](store, further) == 1
        except self.api.Trap:
            return None, text(exports["swz_refusal"](store))
        return text(exports["swz_hash"](store)), None


def in_node(paths: Sequence[Path], into: Path | None = None) -> list[Told]:
    """Hashes or reasons of Node; the Gaussians of each file go to the folder `into`."""
    options = ["--into", into] if into else []
    done = subprocess.run(["node", SCRIPT, *options, *paths], capture_output=True, text=True, check=True)
    return [tuple(json.loads(line)[:2]) for line in done.stdout.splitlines()]


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The package as it is published, the golden files and an empty page over HTTP; the address."""
    shutil.copytree(FOLDER, folder / "package")
    (folder / "golden").symlink_to(GOLDEN)
    (folder / "page.html").write_text("<!doctype html><title>decoder</title><link rel=icon href='data:,'>")
    handler = functools.partial(Quiet, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@contextlib.contextmanager
def opened(address: str, profile: Path) -> Iterator[Chromium]:
    browser = Chromium(find_chromium(), profile, flags=WEBGL)
    try:
        browser.open(SimpleNamespace(resolve=lambda: SimpleNamespace(as_uri=lambda: address)), width=800)
        yield browser
    finally:
        browser.close()


def in_chromium(paths: Sequence[Path], folder: Path) -> list[Told]:
    """Hashes or reasons of Chromium: in a worker, from the package as it is published. `folder` is empty."""
    (folder / "files").mkdir()
    names = []
    for number, path in enumerate(paths):
        names.append(f"{number}.swz")
        (folder / "files" / names[-1]).symlink_to(path.resolve())
    with served(folder) as address, opened(f"{address}/page.html", folder / "profile") as browser:
        found: list[Any] = []
        for name in names:  # one after another: an answer has a time limit
            found.append(
                browser.ask(f"""(async () => {{
              const {{ decode }} = await import('/package/index.js');
              try {{
                return [(await decode(await fetch('/files/{name}'), {{ hash: true }})).hash, null];
              }} catch (error) {{
                return [null, error.message];
              }}
            }})()""")
            )
    return [tuple(each) for each in found]
