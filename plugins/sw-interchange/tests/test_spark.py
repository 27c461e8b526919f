"""Files that Spark (npm, WebAssembly in a browser) reads as they are read here; see `make test-interchange`.

SPARK_MODULES   a node_modules with @sparkjsdev/spark and three
"""

import http.server
import json
import os
import shutil
import subprocess
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rad_files import rad_file, random_rows
from sw_interchange import decode
from sw_interchange.scene import sigmoid

MODULES = os.environ.get("SPARK_MODULES")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(MODULES is None or CHROMIUM is None, reason="no Spark, or no Chromium: make test-interchange"),
]
PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "./modules/three/build/three.module.js",
"three/addons/": "./modules/three/examples/jsm/"}}</script>
<script type="module">
const found = [];
try {
  const {PackedSplats} = await import("./modules/@sparkjsdev/spark/dist/spark.module.js");
  const fileBytes = new Uint8Array(await (await fetch("file.rad")).arrayBuffer());
  const splats = new PackedSplats({fileBytes, fileType: "rad", fileName: "file.rad"});
  await splats.initialized;
  splats.forEachSplat((i, center, scales, quaternion, opacity, color) => found.push([
    ...center.toArray(), ...scales.toArray(), ...quaternion.toArray(), opacity, color.r, color.g, color.b]));
} catch (error) { found.push(String(error)); }
await fetch("/found", {method: "POST", body: JSON.stringify(found)});
</script>"""
QUANTISED = {"center": "f32_lebytes", "alpha": "r8", "rgb": "r8_delta", "scales": "ln_0r8", "orientation": "oct88r8",
             "sh1": "s8", "sh2": "s8_delta", "sh3": "s8"}  # fmt: skip


def by_spark(folder: Path, seconds: float = 120) -> np.ndarray:
    """Rows of file.rad in a folder: centre, scales, quaternion x,y,z,w, opacity, colour."""
    assert MODULES is not None
    assert CHROMIUM is not None
    (folder / "modules").symlink_to(Path(MODULES).resolve())
    (folder / "page.html").write_text(PAGE)
    answers: list[list] = []

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_POST(self) -> None:
            answers.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    # A port for debugging keeps it alive until it is ended; nothing connects to it.
    command = [CHROMIUM, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
               "--remote-debugging-port=0", f"--user-data-dir={folder / 'profile'}",
               f"http://127.0.0.1:{server.server_port}/page.html"]  # fmt: skip
    browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        ends = time.monotonic() + seconds
        while not answers and time.monotonic() < ends:
            time.sleep(0.1)
    finally:
        browser.terminate()
        browser.wait()
        server.shutdown()
    assert answers, "Chromium did not answer"
    assert not isinstance(answers[0][0], str), answers[0]
    return np.array(answers[0])


@pytest.mark.parametrize("encodings", [{}, QUANTISED], ids=["floats", "quantised"])
def test_it_reads_the_same_from_a_rad(tmp_path, encodings):
    data = rad_file(random_rows(60, 3), encodings, chunk=25)
    (tmp_path / "file.rad").write_bytes(data)
    theirs, ours = by_spark(tmp_path), decode(data, name="x.rad")
    # It keeps 16-bit floats of places, 8 bits of the logarithms of scales and of rotations, opacities and colours.
    assert np.allclose(theirs[:, :3], ours.means, atol=2e-3)
    assert np.allclose(theirs[:, 3:6], np.exp(ours.log_scales), rtol=0.05)
    assert np.abs((theirs[:, [9, 6, 7, 8]] * ours.quats).sum(axis=1)).min() > 0.999
    assert np.allclose(theirs[:, 10], sigmoid(ours.opacity_logits), atol=1 / 255)
    assert np.allclose(theirs[:, 11:], 0.5 + 0.28209479177387814 * ours.sh_dc, atol=1 / 255)
