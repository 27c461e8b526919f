"""The method opacity-prune."""

from collections.abc import Sequence

from splatwizard_core.api import Stage
from sw_gaussians.method import GaussianMethod

from sw_third_party import presets
from sw_third_party.config import OpacityPruneConfig
from sw_third_party.stage import OpacityPruneStage


class OpacityPrune(GaussianMethod):
    """Keep the most opaque Gaussians: the simplest pruning there is, from no paper.

    1. PRUNE    the most transparent Gaussians of a trained 3DGS scene
    2. TRAIN    what is left, without adding anything
    3. ENCODE   with the codec that `codec.name` says: version check and limits are its own and GaussianMethod's
    """

    name = "opacity-prune"
    version = 1
    Config = OpacityPruneConfig
    PRESETS = presets.PRESETS
    RATES = presets.RATES
    DEFAULT_RATE = presets.DEFAULT_RATE

    def stages(self) -> Sequence[Stage]:
        return [OpacityPruneStage(self.config)]
