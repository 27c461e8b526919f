"""Who is chosen for a request, what is composed when nobody offers it, and what the user hears."""

import logging
from dataclasses import replace
from itertools import count

import pytest
import torch
from sw_reference import plugin as reference_plugin
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import RasterCase, draw_scene, with_tensors

from splatwizard_core.errors import CapabilityError, ConfigError, PluginError
from splatwizard_core.plugins import catalogue
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.rendering import negotiation
from splatwizard_core.rendering.features import Feature
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions, ScoreSpec
from splatwizard_native import NativeBuildError

_UNIQUE = count()
NOT_HERE = "needs a GPU that is not here"


class Fake:
    """Draws what the reference draws, but refuses what it does not declare."""

    info = RasterizerInfo("fake", frozenset({"cpu"}), frozenset({"float32"}), frozenset())
    calls = 0

    def __init__(self):
        self._inner = ReferenceRasterizer()
        self._inner.info = self.info

    def render(self, g, cam, opt):
        type(self).calls += 1
        return self._inner.render(g, cam, opt)

    def visible_filter(self, g, cam):
        assert "VISIBLE_FILTER" in self.info.features
        return self._inner.visible_filter(g, cam)

    def accumulate(self, g, cams, opt):
        type(self).calls += 1
        return self._inner.accumulate(g, cams, opt)


class FailsToBuild(Fake):
    def __init__(self):
        raise NativeBuildError(REASON)


class FailsToBuildLater(Fake):
    def render(self, g, cam, opt):
        raise NativeBuildError(REASON)


REASON = ""


def not_here():
    return NOT_HERE


def broken_probe():
    raise OSError("libcuda.so")


@pytest.fixture(autouse=True)
def fresh_reason(monkeypatch):
    """Warnings are given once per reason and process: each test has a reason of its own."""
    monkeypatch.setitem(globals(), "REASON", f"no compiler was found ({next(_UNIQUE)})")
    monkeypatch.setitem(globals(), "NOT_HERE", f"needs a GPU that is not here ({next(_UNIQUE)})")
    monkeypatch.delenv("SW_RASTERIZER", raising=False)


@pytest.fixture
def plugins(monkeypatch):
    """A manager with the reference alone, and `install` to add fakes whose target lives in this module."""
    manager = PluginManager([])
    registry = manager.rasterizers
    reference_plugin.register_rasterizers(registry)
    module = type("Holder", (), {})()
    monkeypatch.setitem(__import__("sys").modules, "negotiation_fakes", module)
    module.not_here, module.broken_probe = not_here, broken_probe

    def install(name, *features, base=Fake, speed=5, **declared):
        known = {"devices": ["cpu"], "dtypes": ["float32"], "exactness": "tight", **declared}
        registry.add(name, f"negotiation_fakes:{name}", summary="a fake", features=list(features), speed=speed, **known)
        fake = type(name, (base,), {"info": RasterizerInfo.from_entry(registry.entry(name)), "calls": 0})
        setattr(module, name, fake)
        return fake

    manager.install = install
    return manager


@pytest.fixture
def scene():
    return draw_scene(RasterCase(color="colors"), 0, torch.float32)


def test_the_fastest_that_offers_everything_serves(plugins, scene):
    slow, fast = plugins.install("slow", "ALPHA_MAP", speed=2), plugins.install("fast", "ALPHA_MAP", speed=9)
    plugins.install("fastest", speed=99, features_note="no alpha map", combos_forbidden=[])
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    result = rasterizer.render(*scene, RasterOptions(alpha=True, scores=()))
    assert result.alpha is not None
    assert (slow.calls, fast.calls) == (0, 1)
    assert rasterizer.choices == {"ALPHA_MAP": "fast"}


def test_who_drew_is_told_with_the_kernels_that_really_did(plugins, scene):
    plugins.install("lent", "ALPHA_MAP", speed=9, kernels="slow")
    plugins.install("slow", speed=7)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions(alpha=True))
    assert rasterizer.drawn_by == {"lent": "slow"}
    rasterizer.served.clear()
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.drawn_by == {"lent": "slow"}  # the faster name, of the same kernels
    assert NegotiatedRasterizer(plugins, device="cpu", prefer=["slow"]).drawn_by == {}


def test_each_request_is_resolved_by_itself(plugins, scene):
    plugins.install("painter")
    plugins.install("counter", "SCORE_HITS", speed=1)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    g, cam = scene
    scores = rasterizer.accumulate(g, iter([cam, cam]), RasterOptions(scores=(ScoreSpec("n", "hits"),))).scores["n"]
    assert int(scores.sum()) > 0
    rasterizer.visible_filter(g, cam)
    assert rasterizer.choices == {"plain": "painter", "SCORE_HITS": "counter", "VISIBLE_FILTER": "reference"}


def test_gradients_are_asked_for_only_where_they_are_recorded(plugins, scene):
    plugins.install("painter")
    g, cam = scene
    g.means.requires_grad_()
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    assert rasterizer.render(g, cam, RasterOptions()).image.requires_grad
    with torch.no_grad():
        rasterizer.render(g, cam, RasterOptions())
    assert rasterizer.choices == {"BACKWARD": "reference", "plain": "painter"}


def test_preferred_names_go_first_in_their_order(plugins, scene):
    for name, speed in (("a", 9), ("b", 1), ("c", 5)):
        plugins.install(name, speed=speed)
    for prefer, expected in ((["b", "c"], "b"), (["c", "b"], "c"), (["reference"], "reference"), ([], "a")):
        rasterizer = NegotiatedRasterizer(plugins, device="cpu", prefer=prefer)
        rasterizer.render(*scene, RasterOptions())
        assert rasterizer.choices == {"plain": expected}
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", prefer=["b"], suggested=["missing", "c"], forbid=["b"])
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "c"}


def test_unknown_names_are_errors_with_a_suggestion(plugins, monkeypatch):
    plugins.install("standard")
    for arguments in ({"prefer": ["standart"]}, {"forbid": ["standart"]}):
        with pytest.raises(PluginError, match="did you mean 'standard'"):
            NegotiatedRasterizer(plugins, device="cpu", **arguments)
    monkeypatch.setenv("SW_RASTERIZER", "standart")
    with pytest.raises(PluginError, match="did you mean 'standard'"):
        NegotiatedRasterizer(plugins, device="cpu")


def test_environment_takes_one_rasterizer_or_fails(plugins, scene, monkeypatch):
    plugins.install("fast", speed=9)
    plugins.install("odd", exactness="approx-fp16", speed=1)
    monkeypatch.setenv("SW_RASTERIZER", "odd")
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "odd"}
    with pytest.raises(CapabilityError, match="FISHER"):
        rasterizer.render(*scene, RasterOptions(fisher=True))


def test_approximate_results_must_be_accepted(plugins, scene):
    plugins.install("half", exactness="approx-fp16", speed=50)
    default = NegotiatedRasterizer(plugins, device="cpu")
    default.render(*scene, RasterOptions())
    lenient = NegotiatedRasterizer(plugins, device="cpu", exactness=("exact", "approx-fp16"))
    lenient.render(*scene, RasterOptions())
    assert (default.choices["plain"], lenient.choices["plain"]) == ("reference", "half")


@pytest.mark.parametrize("how", ["prefer", "suggested"])
def test_an_approximate_one_serves_whoever_asks_for_it_by_name(plugins, scene, how):
    plugins.install("half", exactness="approx-fp16", speed=50)
    plugins.install("quarter", exactness="approx-uint8", speed=60)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", **{how: ["half"]})
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices["plain"] == "half"


def test_forbidden_combinations_are_respected(plugins, scene):
    plugins.install("either", "ALPHA_MAP", "DEPTH_MEDIAN", combos_forbidden=[["ALPHA_MAP", "DEPTH_MEDIAN"]])
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions(alpha=True))
    rasterizer.render(*scene, RasterOptions(alpha=True, depth=frozenset({"median"})))
    assert rasterizer.choices == {"ALPHA_MAP": "either", "ALPHA_MAP+DEPTH_MEDIAN": "reference"}


def test_other_devices_are_not_candidates(plugins, scene):
    plugins.install("gpu", devices=["cuda"], speed=99)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "reference"}


def test_an_error_names_what_is_missing_and_who_is_near(plugins, scene):
    plugins.install("gpu", "UINT8_OUT", devices=["cuda"])
    plugins.install("absent", "UINT8_OUT", available="negotiation_fakes:not_here")
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", forbid=["reference"])
    with pytest.raises(CapabilityError) as caught:
        rasterizer.render(*scene, RasterOptions(dtype_out="uint8", alpha=True))
    message = str(caught.value)
    assert "no rasterizer offers ALPHA_MAP + UINT8_OUT on cpu" in message
    assert "gpu (cuda) lacks ALPHA_MAP" in message
    assert "reference (cpu/cuda) lacks UINT8_OUT is forbidden" in message
    assert caught.value.missing == {"ALPHA_MAP"}
    with pytest.raises(CapabilityError, match="Not usable here: absent: needs a GPU"):
        rasterizer.render(*scene, RasterOptions(dtype_out="uint8"))


def warnings(caplog):
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]


@pytest.mark.parametrize("base", [FailsToBuild, FailsToBuildLater])
def test_a_failed_build_falls_back_with_one_warning(plugins, scene, caplog, base):
    plugins.install("native", "ALPHA_MAP", base=base, native="kernels:MODULE")
    plugins.install("sibling", "ALPHA_MAP", base=base, speed=4, native="kernels:MODULE")
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            rasterizer = NegotiatedRasterizer(plugins, device="cpu")
            for options in (RasterOptions(), RasterOptions(alpha=True), RasterOptions()):
                rasterizer.render(*scene, options)
    assert rasterizer.choices == {"plain": "reference", "ALPHA_MAP": "reference"}
    assert len(warnings(caplog)) == 1
    assert REASON in warnings(caplog)[0]
    assert "'reference'" in warnings(caplog)[0]


@pytest.mark.parametrize("raised", [OSError, SystemExit])
def test_a_rasterizer_that_cannot_be_made_harms_no_other(plugins, scene, caplog, monkeypatch, raised):
    class Broken(Fake):
        def __init__(self):
            raise raised(f"libfoo.so ({REASON})")

    plugins.install("broken", base=Broken)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "reference"}
    assert [w for w in warnings(caplog) if f"{raised.__name__}: libfoo.so" in w]
    monkeypatch.setenv("SW_RASTERIZER", "broken")
    with pytest.raises(PluginError, match=rf"'broken' of .* cannot be made: {raised.__name__}: libfoo"):
        NegotiatedRasterizer(plugins, device="cpu").render(*scene, RasterOptions())


def test_a_failed_build_is_told_even_if_another_fast_one_serves(plugins, scene, caplog):
    plugins.install("native", base=FailsToBuild, speed=9)
    plugins.install("other", speed=1)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "other"}
    assert len(warnings(caplog)) == 1


def test_what_cannot_run_here_is_skipped_and_told_if_only_the_oracle_remains(plugins, scene, caplog):
    plugins.install("absent", available="negotiation_fakes:not_here", speed=9)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "reference"}
    assert len(warnings(caplog)) == 1
    assert NOT_HERE in warnings(caplog)[0]
    plugins.install("other", speed=1)
    caplog.clear()
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "other"}
    assert warnings(caplog) == []


def test_the_user_hears_why_a_preferred_one_does_not_serve_and_a_method_s_choice_is_passed_over(plugins, scene, caplog):
    plugins.install("absent", available="negotiation_fakes:not_here", speed=9)
    plugins.install("elsewhere", devices=("cuda",))
    plugins.install("other", speed=1)
    for names in ({"suggested": ["absent", "elsewhere"]}, {"prefer": ["absent", "elsewhere"]}):
        rasterizer = NegotiatedRasterizer(plugins, device="cpu", **names)
        rasterizer.render(*scene, RasterOptions())
        assert rasterizer.choices == {"plain": "other"}
        assert bool(warnings(caplog)) is ("prefer" in names)
    elsewhere, absent = warnings(caplog)
    assert elsewhere == "'elsewhere', which raster.prefer names, does not draw on cpu"
    assert NOT_HERE in absent


def test_a_probe_that_raises_counts_as_a_reason(plugins, scene):
    plugins.install("absent", available="negotiation_fakes:broken_probe", speed=9)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "reference"}


def test_forced_rasterizer_that_cannot_be_built_is_an_error(plugins, scene, monkeypatch):
    plugins.install("native", base=FailsToBuild)
    monkeypatch.setenv("SW_RASTERIZER", "native")
    with pytest.raises(NativeBuildError):
        NegotiatedRasterizer(plugins, device="cpu").render(*scene, RasterOptions())


def test_a_choice_is_logged_once_per_request(plugins, scene, caplog):
    plugins.install("fast")
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    with caplog.at_level(logging.INFO):
        for _ in range(3):
            rasterizer.render(*scene, RasterOptions())
    assert [r.getMessage() for r in caplog.records] == ["plain on cpu: rasterizer 'fast' (tight)"]


@pytest.mark.parametrize("storage", [{"color": "split"}, {"color": "indexed"}, {"geometry": "indexed"}])
def test_storage_forms_are_rewritten_for_a_fast_rasterizer(plugins, storage):
    """The oracle offers them all, but a fast rasterizer behind an adapter goes before it."""
    fake = plugins.install("fast", "BACKWARD")
    g, cam = draw_scene(RasterCase(**storage), 0, torch.float32)
    found = []
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    for r in (rasterizer, ReferenceRasterizer()):
        leaves = {k: v.clone().requires_grad_() for k, v in g.tensors().items() if v.is_floating_point()}
        drawn = with_tensors(g, leaves)
        result = r.render(drawn, cam, RasterOptions())
        assert result.inputs is drawn
        found.append([result.image, *torch.autograd.grad(result.image.square().sum(), list(leaves.values()))])
    assert fake.calls == 1
    assert set(rasterizer.choices.values()) == {"fast"}
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("features", [0, 2])
def test_depth_and_alpha_are_composed_from_features(plugins, features):
    fake = plugins.install("fast", "BACKWARD", "EXTRA_FEATURES")
    g, cam = draw_scene(RasterCase(color="colors", features=features), 0, torch.float32)
    g.means[0] = -10 * cam.R[2]  # behind the camera: z and 1/z of a culled Gaussian must do no harm
    options = RasterOptions(alpha=True, depth=frozenset({"inverse", "expected"}))
    found = []
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    for r in (rasterizer, ReferenceRasterizer()):
        means = g.means.clone().requires_grad_()
        result = r.render(replace(g, means=means), cam, options)
        assert set(result.depth) == {"inverse", "expected"}
        assert (result.features is None) == (features == 0)
        maps = [result.image, result.alpha, *(result.depth[m] for m in sorted(result.depth))]
        maps += [] if result.features is None else [result.features]
        loss = sum(m.square().sum() for m in maps)
        found.append([*maps, *torch.autograd.grad(loss, means)])
    assert fake.calls == 1
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)  # expected depth divides by alphas down to 0.004


def test_maps_that_nobody_asked_for_stay_absent(plugins):
    plugins.install("fast", "EXTRA_FEATURES")
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    scene = draw_scene(RasterCase(color="colors"), 0, torch.float32)
    assert rasterizer.render(*scene, RasterOptions(depth=frozenset({"inverse"}))).alpha is None
    assert rasterizer.render(*scene, RasterOptions(alpha=True)).depth == {}
    assert rasterizer.choices == {"DEPTH_INVERSE": "fast", "ALPHA_MAP": "fast"}


def test_a_median_that_is_offered_stands_beside_maps_that_are_composed(plugins):
    plugins.install("fast", "EXTRA_FEATURES", "DEPTH_MEDIAN")
    scene = draw_scene(RasterCase(color="colors"), 0, torch.float32)
    options = RasterOptions(depth=frozenset({"inverse", "median"}))
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    depth, expected = (r.render(*scene, options).depth for r in (rasterizer, ReferenceRasterizer()))
    assert rasterizer.choices == {"DEPTH_INVERSE+DEPTH_MEDIAN": "fast"}
    for mode in ("inverse", "median"):
        torch.testing.assert_close(depth[mode], expected[mode])


@pytest.mark.parametrize("features", [0, 2])
def test_detached_features_never_detach_a_composed_map(plugins, features):
    """With features of the user's own it cannot be done in one pass, and is said instead of drawn wrongly."""
    plugins.install("fast", "BACKWARD", "EXTRA_FEATURES")
    g, cam = draw_scene(RasterCase(color="colors", features=features), 0, torch.float32)
    options = RasterOptions(depth=frozenset({"inverse"}), features_detach_geometry=True)
    found = []
    for r in (NegotiatedRasterizer(plugins, device="cpu"), ReferenceRasterizer()):
        opacities = g.opacities.clone().requires_grad_()
        drawn = replace(g, opacities=opacities)
        if features and isinstance(r, NegotiatedRasterizer):
            with pytest.raises(CapabilityError, match="cannot detach"):
                r.render(drawn, cam, options)
            return
        found += torch.autograd.grad(r.render(drawn, cam, options).depth["inverse"].sum(), opacities)
    assert float(found[1].abs().max()) > 0
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=1e-4)


def test_scale_factors_are_multiplied_in_for_a_rasterizer_that_reads_none(plugins):
    fake = plugins.install("fast", "VISIBLE_FILTER")
    g, cam = draw_scene(RasterCase(color="colors"), 0, torch.float32)
    g.scale_factors = torch.linspace(0.5, 2.0, len(g))
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    result, expected = (r.render(g, cam, RasterOptions()) for r in (rasterizer, ReferenceRasterizer()))
    assert fake.calls == 1
    assert rasterizer.choices == {"INDEXED_GEOM": "fast"}
    torch.testing.assert_close(result.image, expected.image)
    assert torch.equal(rasterizer.visible_filter(g, cam), expected.radii)
    plain = ReferenceRasterizer().render(replace(g, scale_factors=None), cam, RasterOptions())
    assert not torch.allclose(result.image, plain.image)


def test_scores_are_summed_whatever_maps_the_options_name(plugins):
    plugins.install("counter", "EXTRA_FEATURES", "SCORE_HITS")
    g, cam = draw_scene(RasterCase(color="colors"), 0, torch.float32)
    options = RasterOptions(scores=(ScoreSpec("n", "hits"),), alpha=True)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    scores, expected = (r.accumulate(g, [cam], options).scores["n"] for r in (rasterizer, ReferenceRasterizer()))
    assert rasterizer.choices == {"ALPHA_MAP+SCORE_HITS": "counter"}
    assert torch.equal(scores, expected)


def test_median_depth_is_not_composed(plugins, scene):
    plugins.install("fast", "EXTRA_FEATURES")
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions(depth=frozenset({"median"})))
    assert rasterizer.choices == {"DEPTH_MEDIAN": "reference"}


def test_visible_filter_needs_no_colour_feature(plugins):
    plugins.install("fast", "VISIBLE_FILTER")
    g, cam = draw_scene(RasterCase(color="split", features=2), 0, torch.float32)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    assert torch.equal(rasterizer.visible_filter(g, cam), ReferenceRasterizer().visible_filter(g, cam))
    assert rasterizer.choices == {"VISIBLE_FILTER": "fast"}


def test_unknown_declared_feature_is_an_error(plugins):
    with pytest.raises(PluginError, match="TELEPORT"):
        plugins.install("odd", "TELEPORT")


@pytest.mark.parametrize("declared", [{"features": ["TELEPORT"]}, {"devices": 5}, {"speed": "fast"}])
def test_an_entry_that_cannot_be_read_harms_no_other(plugins, scene, caplog, declared):
    """A plugin made for a newer core; whoever asks for it by name hears why."""
    name = f"odd{next(_UNIQUE)}"
    plugins.rasterizers.add(name, "negotiation_fakes:odd", summary="a fake", **declared)
    for _ in range(2):
        rasterizer = NegotiatedRasterizer(plugins, device="cpu")
        rasterizer.render(*scene, RasterOptions())
        with pytest.raises(CapabilityError, match="UINT8_OUT"):
            rasterizer.render(*scene, RasterOptions(dtype_out="uint8"))
    assert rasterizer.choices == {"plain": "reference"}
    assert len([w for w in warnings(caplog) if name in w]) == 1
    with pytest.raises(PluginError, match=name):
        NegotiatedRasterizer(plugins, device="cpu", prefer=[name])


def test_unknown_option_values_are_refused(scene):
    for options in ({"dtype_out": "uint16"}, {"depth": frozenset({"mean"})}, {"scores": (ScoreSpec("a", "glow"),)}):
        with pytest.raises(ValueError, match=r"uint16|mean|glow"):
            ReferenceRasterizer().render(*scene, RasterOptions(**options))


def test_negotiated_info_is_the_union(plugins):
    plugins.install("fast", "UINT8_OUT")
    info = NegotiatedRasterizer(plugins, device="cpu").info
    assert {"UINT8_OUT", "BACKWARD"} <= info.features
    assert info.features <= {f.name for f in Feature}


def test_a_rasterizer_of_surfels_is_never_taken_for_anything_else(plugins, scene):
    flat = plugins.install("flat", "SURFEL", "BACKWARD", needs=["SURFEL"], speed=99)
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", prefer=["flat"])
    g, cam = scene
    rasterizer.render(g, cam, RasterOptions())
    rasterizer.render(replace(g, scales=g.scales[:, :2]), cam, RasterOptions())
    rasterizer.render(replace(g, scales=g.scales[:, :2]), cam, RasterOptions(normals=True))
    assert rasterizer.choices == {"plain": "reference", "SURFEL": "flat", "NORMALS+SURFEL": "reference"}
    with pytest.raises(CapabilityError, match="'flat' draws nothing without SURFEL"):
        flat.info.check_offered(Feature.BACKWARD)
    with pytest.raises(CapabilityError, match=r"flat \(cpu\) draws nothing without SURFEL"):
        NegotiatedRasterizer(plugins, device="cpu", forbid=["reference"]).render(g, cam, RasterOptions())


def test_without_any_rasterizer_the_error_names_what_to_install(scene, monkeypatch):
    def error(known):
        for module in (negotiation, catalogue):
            monkeypatch.setattr(module, "catalogue", lambda: {"rasterizer": known})
        with pytest.raises(CapabilityError) as caught:
            NegotiatedRasterizer(PluginManager([]), device="cpu").render(*scene, RasterOptions())
        return str(caught.value)

    assert error({"quick": "sw-absent"}) == "no rasterizer is installed: pip install sw-absent"
    several = error({"quick": "sw-absent", "slow": "sw-absent", "odd": "sw-missing"})
    assert several == "no rasterizer is installed: install one of sw-absent, sw-missing with pip"
    assert "`sw list-plugins`" in error({})


def test_the_fallback_is_the_one_that_declares_no_speed(scene, caplog):
    """By what it declares, whatever its name; another package's oracle will do."""
    manager = PluginManager([])
    declared = {"target": "sw_reference.rasterizer:ReferenceRasterizer", "summary": "an oracle", "devices": ["cpu"]}
    manager.rasterizers.add("their-oracle", speed=0, **declared)
    manager.rasterizers.add("native", speed=9, available=f"{__name__}:not_here", **declared)
    rasterizer = NegotiatedRasterizer(manager, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    assert rasterizer.choices == {"plain": "their-oracle"}
    assert rasterizer.served == {"reference"}  # the class says so itself
    assert [w for w in warnings(caplog) if "rendering with 'their-oracle' instead" in w]


def test_a_profile_must_be_declared(plugins, scene):
    fake = plugins.install("fast", profiles=["classic"])
    fake.info.check_request(scene[0], RasterOptions())
    fake.info.check_request(scene[0], RasterOptions(profile="classic"))
    with pytest.raises(ConfigError, match="'fast' knows no profile 'dgr-exact'; one of classic"):
        fake.info.check_request(scene[0], RasterOptions(profile="dgr-exact"))
    with pytest.raises(ConfigError, match="clamp_grad is 'never'"):
        fake.info.check_request(scene[0], RasterOptions(clamp_grad="never"))


def test_a_visible_filter_asks_for_the_shapes_alone(plugins):
    g, _ = draw_scene(RasterCase(color="split", features=2), 0, torch.float32)
    plugins.install("fast", "VISIBLE_FILTER").info.check_geometry(g)
    with pytest.raises(CapabilityError, match="VISIBLE_FILTER"):
        plugins.install("blind").info.check_geometry(g)
    g.scale_factors = torch.ones(len(g))
    with pytest.raises(CapabilityError, match="INDEXED_GEOM"):
        plugins.rasterizers.load("fast").info.check_geometry(g)


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ((ScoreSpec("a", "hits", rule="always"),), "rule is 'always', must be 'blended' or 'tested'"),
        ((ScoreSpec("a", "grad_sq", rule="tested"),), "must be 'blended'"),
        ((ScoreSpec("a", "hits", torch.ones(2, 2)),), r"pixel_weight is \[2, 2\], must be \["),
        ((ScoreSpec("a", "hits"), ScoreSpec("a", "blend")), "two scores have one name: a, a"),
    ],
)
def test_scores_that_make_no_sense_are_refused(scene, scores, message):
    with pytest.raises(ConfigError, match=message):
        RasterOptions(scores=scores).check_scores(scene[1])


def test_counts_are_whole_numbers_unless_they_are_weighted():
    mask, weight = torch.ones(2, 2, dtype=torch.bool), torch.ones(2, 2)
    assert ScoreSpec("n", "hits").dtype == ScoreSpec("n", "hits", mask).dtype == torch.int32
    assert ScoreSpec("n", "hits", weight).dtype == ScoreSpec("n", "blend").dtype == torch.float32


def test_a_profile_is_served_by_one_that_knows_it(plugins, scene):
    plain, quirky = plugins.install("plain", speed=9), plugins.install("quirky", speed=2, profiles=["old-tiles"])
    rasterizer = NegotiatedRasterizer(plugins, device="cpu")
    rasterizer.render(*scene, RasterOptions())
    rasterizer.render(*scene, RasterOptions(profile="old-tiles"))
    assert plain.calls == quirky.calls == 1
    assert rasterizer.choices == {"plain": "plain", "profile old-tiles": "quirky"}
    with pytest.raises(CapabilityError, match=r"no rasterizer offers profile newer on cpu; nearest: .* lacks profile"):
        rasterizer.render(*scene, RasterOptions(profile="newer"))


def test_the_users_options_hold_in_place_of_those_of_a_request(plugins, scene):
    reference = ReferenceRasterizer()
    decided = {"antialias": True, "profile": "dgr-exact", "eps2d": 0.5}
    rasterizer = NegotiatedRasterizer(plugins, device="cpu", options=decided)
    asked = RasterOptions(profile="3dgs", alpha=True)
    expected = reference.render(*scene, replace(asked, **decided))
    assert torch.equal(rasterizer.render(*scene, asked).image, expected.image)
    assert not torch.equal(reference.render(*scene, asked).image, expected.image)
    assert rasterizer.choices == {"ALPHA_MAP+ANTIALIAS+profile dgr-exact": "reference"}
    scores = replace(asked, scores=(ScoreSpec("hits", "hits"),))
    summed = rasterizer.accumulate(scene[0], [scene[1]], scores).scores["hits"]
    wanted = reference.render(*scene, replace(scores, **decided)).scores["hits"]
    assert torch.equal(summed, wanted)
    assert rasterizer.decided(asked).alpha


def test_a_profile_that_nobody_knows_is_told_with_those_that_there_are(plugins):
    plugins.install("quirky", profiles=["old-tiles", "3dgs"])
    with pytest.raises(ConfigError) as caught:
        NegotiatedRasterizer(plugins, device="cpu", options={"profile": "dgr"})
    assert str(caught.value) == (
        "no rasterizer knows the profile 'dgr': raster.profile is one of 3dgs, dgr-exact, old-tiles"
    )
    assert caught.value.key == "raster.profile"


def test_features_that_nobody_offers_together_are_told(plugins):
    with pytest.raises(CapabilityError, match=r"reference \(cpu/cuda\) has no ANTIALIAS with SURFEL"):
        NegotiatedRasterizer(plugins, device="cpu").select({"ANTIALIAS", "SURFEL"})
