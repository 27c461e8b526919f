"""OpenUSD: what is written is what usd-core reads, what it writes is read, and files made to do harm are refused.

The text of a .usda is looked at without usd-core; the other tests need it (`make test-interchange` installs it), and
USD_CONVERT_PYTHON, a Python that imports usd_convert_gsplat, is NVIDIA's converter.
"""

import importlib.util
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from interchange_files import covariances, random_scene
from sw_interchange import GaussianScene, decode, encode, read, usd, usd_writer, write
from sw_interchange.frames import transformed
from sw_interchange.scene import sigmoid

from splatwizard_core.api import BitstreamError, CapabilityError, SplatwizardError, UserInputError

CONVERTER = os.environ.get("USD_CONVERT_PYTHON")
with_usd_core = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="no usd-core: make test-interchange")
SECONDS = 5
"""Of a refusal, a process of usd-core included: 2 s of a processor at most, and shared cores are slower."""


def numbers(text: str, name: str) -> np.ndarray:
    """The float32 values of an attribute of a .usda."""
    found = re.search(rf" {name} = (\[.*?\])( \(|\n)", text)
    assert found, name
    return np.array(re.findall(r"[-+.\de]+(?:inf|nan)?", found[1]), np.float32)


def check(scene: GaussianScene, found: GaussianScene, *, atol: float = 0) -> None:
    assert np.allclose(scene.means, found.means, rtol=0, atol=atol)
    assert np.allclose(scene.log_scales, found.log_scales, atol=2e-6)
    assert np.allclose(sigmoid(scene.opacity_logits), sigmoid(found.opacity_logits), atol=1e-6)
    assert np.allclose(scene.sh_dc, found.sh_dc, rtol=0, atol=atol)
    assert np.allclose(scene.sh_rest, found.sh_rest, rtol=0, atol=atol)
    ours, theirs = covariances(scene), covariances(found)
    assert (np.abs(ours - theirs).max((1, 2)) < 1e-5 * np.abs(ours).max((1, 2))).all()


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_the_text_holds_every_bit_and_keeps_the_rules_of_the_schema(degree):
    """Lengths, unit quaternions, ranges, an extent of three deviations: what NVIDIA's validator asks for."""
    scene = random_scene(40, degree)
    text = encode(scene, "usda")[0].decode()
    turned = scene.in_frame("RUB")
    assert np.array_equal(numbers(text, "positions").reshape(-1, 3), turned.means)
    sh = numbers(text, "radiance:sphericalHarmonicsCoefficients").reshape(40, (degree + 1) ** 2, 3)
    assert np.array_equal(sh[:, 0], turned.sh_dc)
    assert np.array_equal(sh[:, 1:], turned.sh_rest)
    assert f"uniform int radiance:sphericalHarmonicsDegree = {degree}\n" in text
    assert f"elementSize = {(degree + 1) ** 2}\n" in text
    quats = numbers(text, "orientations").reshape(-1, 4)
    assert np.array_equal(quats, turned.quats)
    assert np.allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
    scales, alphas = numbers(text, "scales").reshape(-1, 3), numbers(text, "opacities")
    assert scales.min() > 0
    assert 0 < alphas.min() < alphas.max() < 1
    low, high = numbers(text, "extent").reshape(2, 3)
    assert (low <= turned.means - 3 * scales.min(1, keepdims=True)).all()
    assert (high >= turned.means + 3 * scales.min(1, keepdims=True)).all()
    assert (low >= turned.means.min(0) - 3 * scales.max()).all()
    assert 'defaultPrim = "Splats"' in text
    assert 'upAxis = "Y"' in text


def test_too_many_for_a_text_are_refused(monkeypatch):
    monkeypatch.setattr(usd_writer, "MAX_TEXT", 3)
    with pytest.raises(UserInputError, match=r"write a \.usdc"):
        encode(random_scene(4, 0), "usda")


def test_without_usd_core_the_package_is_named(tmp_path, monkeypatch):
    write(random_scene(3, 0), tmp_path / "a.usda")
    monkeypatch.setattr(usd.importlib.util, "find_spec", lambda name: None)
    for work in (lambda: read(tmp_path / "a.usda"), lambda: encode(random_scene(3, 0), "usdz")):
        with pytest.raises(CapabilityError, match="pip install usd-core"):
            work()


@with_usd_core
@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
@pytest.mark.parametrize(("degree", "axis"), [(0, "Y"), (3, "Y"), (3, "Z"), (4, "Y")])
def test_a_scene_survives(suffix, degree, axis, tmp_path):
    scene = random_scene(60, degree)
    write(scene, path := tmp_path / f"a.{suffix}", up_axis=axis)
    found = read(path)
    assert (found.report.format, found.report.stored_frame) == (suffix, "RUB" if axis == "Y" else "RFU")
    check(scene, found, atol=1e-5 if axis == "Z" else 0)  # a turn by 90 degrees of the bands of SH
    assert found.meta["meters_per_unit"] == 1
    check(found, decode(path.read_bytes()))


@with_usd_core
@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_how_it_is_to_be_drawn_is_kept(suffix):
    scene = random_scene(4, 0)
    scene.antialiased, scene.kind = True, "2dgs"
    scene.log_scales[:, 2] = -20
    found = decode(encode(scene, suffix)[0])
    assert (found.antialiased, found.kind) == (True, "2dgs")
    assert np.allclose(found.log_scales[:, 2], -20, atol=1e-5)


@with_usd_core
@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_usd_core_finds_the_schema_and_the_values(suffix, tmp_path):
    from pxr import Usd, UsdGeom, UsdVol

    scene = random_scene(30, 2)
    write(scene, path := tmp_path / f"a.{suffix}")
    stage = Usd.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splats
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    turned = scene.in_frame("RUB")
    assert np.array_equal(splats.GetPositionsAttr().Get(), turned.means)
    assert np.array_equal(np.array(splats.GetOrientationsAttr().Get())[:, [3, 0, 1, 2]], turned.quats)
    assert np.allclose(splats.GetScalesAttr().Get(), np.exp(turned.log_scales), rtol=1e-6)
    assert np.allclose(splats.GetOpacitiesAttr().Get(), sigmoid(turned.opacity_logits), atol=1e-7)
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(30, 9, 3)
    assert np.array_equal(sh[:, 1:], turned.sh_rest)


PRIM = """
def Xform "World" ({about}) {{
    double3 xformOp:translate = (1, 2, 3)
    float xformOp:rotateZ = 90
    float3 xformOp:scale = {scale}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
    def ParticleField3DGaussianSplat "S" {{
        point3f[] positions = [(1, 0, 0), (0, 1, 0)]
        {quats} = [(1, 0, 0, 0), (2, 0, 0, 0)]
        {half}3[] scales{h} = [(0.5, 1, 2), (0, 1, 1)]
        {half}[] opacities{h} = [0.5, 1]
        {more}
    }}
}}
"""
SH = "float3[] radiance:sphericalHarmonicsCoefficients = {values}\nuniform int radiance:sphericalHarmonicsDegree = {d}"


def text(
    prim: str = PRIM, *, top: str = "", about: str = "", scale: str = "(2, 2, 2)", more: str = "", half: bool = False
) -> bytes:
    names = {"quats": "quath[] orientationsh", "half": "half", "h": "h"}
    if not half:
        names = {"quats": "quatf[] orientations", "half": "float", "h": ""}
    return f"#usda 1.0\n({top})\n{prim.format(about=about, scale=scale, more=more, **names)}".encode()


@with_usd_core
@pytest.mark.parametrize("half", [False, True])
def test_prims_are_moved_by_those_above_them(half):
    found = decode(text(half=half, more=SH.format(values=[(1, 2, 3)] * 8, d=1)), frame=None)
    assert found.frame == "RUB"
    assert np.allclose(found.means, [[1, 4, 3], [-1, 2, 3]])
    with np.errstate(divide="ignore"):
        assert np.allclose(found.log_scales[0], np.log([1, 2, 4]), atol=1e-6)
    assert found.log_scales[1, 0] < -19
    assert np.allclose(sigmoid(found.opacity_logits), [0.5, 1], atol=1e-5)
    unturned = GaussianScene(
        found.means, found.log_scales, np.tile(np.float32([1, 0, 0, 0]), (2, 1)), found.opacity_logits, found.sh_dc,
        np.tile(np.float32([1, 2, 3]), (2, 3, 1)),
    )  # fmt: skip
    turned = transformed(unturned, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert np.allclose(found.sh_rest, turned.sh_rest, atol=1e-5)
    assert np.allclose(np.abs((found.quats * turned.quats).sum(1)), 1, atol=1e-6)


@with_usd_core
def test_coefficients_beyond_the_degree_are_cut_and_too_few_are_grey():
    found = decode(text(more=SH.format(values=[(i, 0, 0) for i in range(5)], d=0)))
    assert found.sh_dc[:, 0].tolist() == [0, 1]
    for more in ("", SH.format(values=[(1, 1, 1)] * 7, d=1)):
        found = decode(text(more=more))
        assert found.sh_degree == 0
        assert not found.sh_dc.any()
        assert "it is grey" in found.report.warnings[0]


@with_usd_core
def test_several_prims_make_one_scene_and_those_not_drawn_stay_out():
    hidden = PRIM.replace('"World"', '"Hidden"').replace('"S" {{', '"S" {{ token visibility = "invisible"')
    more = SH.format(values=[(1, 1, 1)] * 2, d=0)
    found = decode(text(PRIM + PRIM.replace('"World"', '"Other"') + hidden, more=more))
    assert found.num_gaussians == 4
    assert "/Hidden/S is invisible" in found.report.warnings[0]


BROKEN = PRIM.replace("[(0.5, 1, 2), (0, 1, 1)]", "[(0.5, 1, 2)]")
POINTS = """def PointInstancer "P" {{
    rel prototypes = </P/World>
    int[] protoIndices = [0]
"""
INSTANCE = """def Xform "B" (
    instanceable = true
    references = </World>
) {{}}"""
BAD = {
    "another file": (text(about='references = @/etc/passwd@</a>'), "names another file"),
    "a file beside it": (text(top='subLayers = [@other.usda@]'), "names another file"),
    "a payload": (text(about='payload = @./other.usdc@'), "names another file"),
    "itself": (text(about='references = @./scene.usd@'), "names another file"),
    "an instance": (text(PRIM + INSTANCE), "instances"),
    "instances at points": (
        text(POINTS + PRIM + "}}", more=SH.format(values=[(1, 1, 1)] * 2, d=0)), "instances"),
    "a mirror": (text(scale="(-1, 1, 1)"), "mirrors"),
    "a shear": (text(scale="(1, 2, 1)"), "shear"),
    "fewer scales": (text(BROKEN), "1 scales for 2 positions"),
    "no positions": (text(PRIM.replace("[(1, 0, 0), (0, 1, 0)]", "[]")), "no positions"),
    "a huge degree": (text(more=SH.format(values=[(1, 1, 1)], d=1 << 30)), "0 to 4"),
    "a negative degree": (text(more=SH.format(values=[(1, 1, 1)], d=-1)), "0 to 4"),
    "no splats": (b'#usda 1.0\ndef Mesh "M" {}', "no splats in it"),
    "nothing drawn": (
        text(PRIM.replace('"S" {{', '"S" {{ token visibility = "invisible"')), "none of its splats is drawn: /World/S"),
    "words": (b"#usda 1.0\nnonsense", "damaged"),
    "brackets": (b"#usda 1.0\n" + b'def Xform "A" {' * 200_000, "damaged|breaks off"),
    "a crate of zeros": (b"PXR-USDC" + bytes(4096), "damaged"),
}  # fmt: skip


@with_usd_core
@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused(name):
    data, reason = BAD[name]
    with pytest.raises(BitstreamError, match=reason) as caught:  # the reader's process has a limit of CPU time
        decode(data)
    assert len(str(caught.value)) < 400


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux tells what a process does")
def test_a_program_that_only_waits_is_ended(tmp_path):
    program = "import _thread; lock = _thread.allocate_lock(); lock.acquire(); lock.acquire()"
    assert usd._run([sys.executable, "-S", "-c", program], tmp_path / "answer") != 0


def test_a_program_that_works_is_waited_for(tmp_path):
    program = "for _ in range(5_000_000): pass\nprint('done')"
    assert usd._run([sys.executable, "-S", "-c", program], tmp_path / "answer") == 0
    assert (tmp_path / "answer").read_text() == "done\n"


@with_usd_core
@pytest.mark.slow
def test_usd_core_is_ended_where_it_would_wait_for_ever():
    """So many prims take more memory than there is, and a thread of it that finds none leaves the others waiting."""
    data, start = b"#usda 1.0\n" + b"".join(b'def "a%d" {}\n' % i for i in range(300_000)), time.monotonic()
    with pytest.raises(BitstreamError, match="breaks off on it"):
        decode(data)
    assert time.monotonic() - start < SECONDS


@with_usd_core
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_what_has_only_the_suffix_is_called_damaged(suffix, tmp_path):
    (tmp_path / f"x{suffix}").write_bytes(bytes(300))
    with pytest.raises(BitstreamError, match="damaged, or no OpenUSD"):
        read(tmp_path / f"x{suffix}")


@with_usd_core
def test_layers_inside_of_an_archive_are_read_and_none_beyond_it(tmp_path):
    from pxr import Sdf

    (tmp_path / "a.usda").write_bytes(text(more=SH.format(values=[(1, 1, 1)] * 2, d=0)))
    for number, (asset, good) in enumerate({"./a.usda": True, "../a.usda": False, "/etc/passwd": False}.items()):
        (tmp_path / "root.usda").write_text(f"#usda 1.0\n(subLayers = [@{asset}@])\n")
        path = tmp_path / f"{number}.usdz"
        with Sdf.ZipFileWriter.CreateNew(str(path)) as archive:
            archive.AddFile(str(tmp_path / "root.usda"), "root.usda")
            archive.AddFile(str(tmp_path / "a.usda"), "a.usda")
        if good:
            assert read(path).num_gaussians == 2
        else:
            with pytest.raises(BitstreamError, match="names another file"):
                read(path)


@with_usd_core
@pytest.mark.slow
def test_flipped_bytes_give_a_scene_or_a_typed_error():
    """usd-core itself crashes on one in two hundred of these."""
    rng = np.random.default_rng(0)
    sound, survived = encode(random_scene(100, 1), "usdc")[0], 0
    for _ in range(200):
        data = bytearray(sound)
        for _ in range(int(rng.integers(1, 4))):
            data[len(data) - 1 - int(rng.integers(1500))] = int(rng.integers(256))
        start = time.monotonic()
        try:
            assert decode(bytes(data)).num_gaussians <= 100
            survived += 1
        except SplatwizardError:
            pass
        assert time.monotonic() - start < SECONDS
    assert 0 < survived < 200


@pytest.mark.slow
@with_usd_core
@pytest.mark.skipif(CONVERTER is None, reason="no usd-convert-gsplat: make test-interchange")
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_the_converter_of_nvidia_writes_is_read_here(degree, tmp_path):
    """It leaves out the turn to a world that points up."""
    scene = random_scene(50, degree)
    write(scene, tmp_path / "a.ply")
    assert CONVERTER is not None
    command = [CONVERTER, "-m", "usd_convert_gsplat", "-i", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.usdz")]
    subprocess.run(command, check=True, capture_output=True, timeout=300, env={**os.environ, "PYTHONPATH": ""})
    check(scene, read(tmp_path / "b.usdz", frame=None), atol=1e-6)
