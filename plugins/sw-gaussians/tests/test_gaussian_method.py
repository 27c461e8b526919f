"""What a method of Gaussians need not say itself: its file, by a codec that is asked for in time, and its start."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.method import GaussianMethod

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError, PluginError, SceneError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.registry import Coders, Registry
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.params import OptimizationParams

SHAPES = {"means": (3,), "sh_dc": (1, 3), "sh_rest": (0, 3), "opacity_logits": (), "log_scales": (3,), "quats": (4,)}


class ToyCodec:
    """A codec of Gaussians: one array for each tensor."""

    def __init__(self, plugins):
        pass

    def encode(self, model, writer):
        for name in SHAPES:
            writer.add_array(name, getattr(model, name).detach().numpy())

    def decode(self, reader):
        arrays = {name: reader.array(name, dtype="<f4").astype(np.float32) for name in SHAPES}
        return GaussianModel.from_tensors(**{name: torch.from_numpy(array) for name, array in arrays.items()})


class ToyConfig(Choosing):
    codec: CodecChoice = CodecChoice(name="toy-codec")


class Toy(GaussianMethod):
    name = "toy"
    Config = ToyConfig

    def stages(self):
        return [SimpleNamespace(starts_from="gaussians-of-old")]


@pytest.fixture
def plugins():
    coders = Registry("coder")
    coders.add("toy-codec", f"{__name__}:ToyCodec", summary="", codes="gaussians")
    coders.add("range", f"{__name__}:NoSuchClass", summary="an entropy coder")
    methods = Registry("method")
    methods._owner = ("sw-of-toys", "1.0", True)
    methods.add("toy", f"{__name__}:Toy", summary="")
    return SimpleNamespace(coders=coders, gaussian_codecs=Coders(coders, "gaussians"), methods=methods)


@pytest.fixture
def model():
    g = torch.Generator().manual_seed(0)
    return GaussianModel(*(torch.randn(5, *shape, generator=g) for shape in SHAPES.values()))


def written(plugins, model) -> ContainerReader:
    writer = ContainerWriter(Toy.name, Toy.version)
    Toy(plugins, ToyConfig()).encode(model, writer)
    return ContainerReader(writer.to_bytes(), "file.swz")


def test_the_codec_of_the_config_writes_the_file_which_says_so(plugins, model):
    reader = written(plugins, model)
    assert reader.static["codec"] == "toy-codec"
    decoded = Toy(plugins, None).decode(reader)
    for (name, ours), (_, theirs) in zip(model.named_parameters(), decoded.named_parameters(), strict=True):
        assert torch.equal(ours, theirs), name


@pytest.mark.parametrize(("codec", "told"), [("zip", "called 'zip'"), ("range", "'range' does not .* do: toy-codec")])
def test_a_codec_that_is_not_one_of_gaussians_is_told_before_anything_is_trained(plugins, codec, told):
    with pytest.raises(ConfigError, match=told) as error:
        Toy(plugins, ToyConfig(codec=codec))
    assert error.value.key == "codec.name"


def test_a_config_whose_codec_is_a_name_alone_is_the_authors_to_change(plugins):
    class Older(OptimizationParams):
        codec: str = "toy-codec"

    with pytest.raises(PluginError, match=r"method 'toy' cannot be used: `codec` of its Older must be a CodecChoice"):
        Toy(plugins, Older())


def test_another_layout_version_is_refused(plugins, model):
    reader = written(plugins, model)
    reader.version = 7
    with pytest.raises(BitstreamError, match=r"toy layout version 7 is unknown, this installation reads"):
        Toy(plugins, None).decode(reader)


def test_what_is_no_set_of_gaussians_is_no_file(plugins):
    with pytest.raises(TypeError, match="toy encodes a GaussianModel"):
        written(plugins, torch.nn.Linear(1, 1))


def test_a_method_starts_from_points_where_no_stage_starts_from_a_trained_scene(plugins):
    class FromPoints(Toy):
        def stages(self):
            return [SimpleNamespace(starts_from=None)]

    xyz = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    scene = SimpleNamespace(name="s", path="somewhere", points=PointCloud(xyz))
    model = FromPoints(plugins, ToyConfig()).create_model(scene, None)
    assert torch.equal(model.means, xyz)
    assert model.max_sh_degree == 3

    class Flat(ToyConfig):
        sh_degree: int = 1

    assert FromPoints(plugins, Flat()).create_model(scene, None).max_sh_degree == 1
    scene.points = None
    with pytest.raises(SceneError, match="has no start points: toy needs SfM points"):
        FromPoints(plugins, ToyConfig()).create_model(scene, None)


def test_a_method_whose_stage_starts_from_a_trained_scene_refuses_points(plugins):
    with pytest.raises(SceneError, match="toy starts from a trained gaussians-of-old scene"):
        Toy(plugins, ToyConfig()).create_model(SimpleNamespace(path="somewhere"), None)
