"""The sections of an edit's config."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..config import Count, Fraction, NonNegative
from ..errors import ConfigError, choose
from ..guidance.config import GuidanceConfig
from ..loss.anchor import AnchorConfig
from .density import DensifyConfig
from .preview import PreviewConfig
from .sourced import SourcedParts

REGIONS = ("current", "start", "everywhere")


@dataclass(frozen=True)
class PromptConfig:
    """What is wanted, in words."""

    prompt: str = ""  # the instruction (a description where the prior is a text-to-image model)
    source_prompt: str = ""  # a description of the source, for rules that compare with it (dds, pds)

    def __post_init__(self) -> None:
        if not self.prompt.strip():
            raise ConfigError('prompt: is empty. Say what is wanted, e.g. prompt="Make it sunset".')


@dataclass(frozen=True)
class LossConfig:
    """What is minimised, as a sum of terms; the anchors' weights stand in `anchor`."""

    lambda_guidance: NonNegative = 1.0  # of the rule's loss (GaussianEditor's lambda_l1 = 10 for pictures)
    region: str = "current"  # what a mask lets change of an image: current | start | everywhere (as published)
    reach: Fraction = 0.06  # so far beyond the editable splats of the moment, a fraction of the longer side
    lambda_outside: NonNegative = 3.0  # of L1 to the source where no editable splat is seen
    lambda_perceptual: NonNegative = 0.0  # of LPIPS, for rules that deliver a picture (GaussianEditor's lambda_p = 10)
    perceptual_weights: str = ""  # a folder with VGG-16's and LPIPS's weight files (loss/perceptual.py)

    def __post_init__(self) -> None:
        choose("region", self.region, REGIONS, "region")
        if self.lambda_perceptual and not self.perceptual_weights:
            raise ConfigError(
                "perceptual_weights: is empty. LPIPS needs the folder that holds its two weight files; or set "
                "lambda_perceptual=0"
            )


@dataclass(frozen=True)
class EditDensifyConfig(DensifyConfig):
    """Density control of an edit: the source has large splats of its own, a sky for one, which are no mistake."""

    max_size: NonNegative = 0.0
    max_splats: Count = 5_000_000  # a scene of one's own may have millions to begin with; an edit adds few to them


@dataclass(frozen=True)
class FirstFitConfig:
    """The fit with which an edit of photographs begins where no gs_source is given: a run of configs/fit.yaml at the
    size at which the edit draws. Only our own launcher makes one."""

    steps: Count = 3000  # 0: none, splats must be given
    data: dict = field(default_factory=dict)  # keys of that YAML's `data` and `system`, with other values
    system: dict = field(default_factory=dict)


@dataclass(frozen=True)
class EditParts(SourcedParts):
    """The parsed sections of an edit."""

    guidance: GuidanceConfig
    prompt_processor: PromptConfig
    preview: PreviewConfig
    densify: EditDensifyConfig
    anchor: AnchorConfig
    loss: LossConfig
    first_fit: FirstFitConfig
