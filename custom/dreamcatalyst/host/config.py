"""The config of a guidance inside threestudio's own systems: our keys, what else it must be told, the host's keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from ..config import AtLeastOne, Count, DdimSteps, Fraction, NonNegative, Number, Range, Scalar, Seed

# The host's name of an option of the prior: ours (a dot leads into a section), and the host's values as ours where they
# differ. A value that is not among these says nothing.
ALIASES: dict[str, tuple[str, Mapping[Any, Any] | None]] = {
    "ip2p_name_or_path": ("path", None),
    "half_precision_weights": ("dtype", {True: "fp16", False: "fp32"}),
    "enable_sequential_cpu_offload": ("offload", {True: True}),
    "enable_channels_last_format": ("channels_last", {True: True}),
    "freeu_b1": ("freeu.b1", None),
    "freeu_b2": ("freeu.b2", None),
    "freeu_s1": ("freeu.s1", None),
    "freeu_s2": ("freeu.s2", None),
}

# Keys of the host's guidances for which there is nothing to do here, and why. They are accepted, and named once.
WITHOUT_EFFECT = {
    "pretrained_model_name_or_path": "of its text-to-image model; ours is prior.path",
    "ddim_scheduler_name_or_path": "the noise schedule is the one in the prior's folder",
    "cache_dir": "HF_HOME says where downloads are kept",
    "enable_memory_efficient_attention": "torch's attention is",
    "enable_attention_slicing": "torch's attention does without",
    "weighting_strategy": "the rule says it",
    "use_sds": "the guidance that was chosen says it",
    "use_dds": "the guidance that was chosen says it",
    "use_dreamcatalyst": "the rule says it",
    "use_sjc": "the rule says it",
    "use_img_loss": "the rule says it",
    "var_red": "of another rule",
    "grad_clip": "gradients are never changed; one that is not finite is an error",
    "sqrt_anneal": "timesteps and their limits say it",
    "control_type": "of another prior",
}


Limit = Annotated[Scalar, Range("[0, 1]")]


@dataclass
class HostConfig:
    """A plain dataclass, since the host's are not frozen and may not inherit one that is."""

    # --- GuidanceConfig's own keys (guidance/config.py), with other defaults where the host's differ
    prior_type: str = "ip2p"  # a name in PRIORS (diffusion/api.py)
    prior: dict = field(default_factory=dict)  # the prior's own options
    rule: str = "dreamcatalyst"  # a name in RULES (guidance/rules.py)
    preset: str = "paper"  # chi, delta, gamma: paper | published-3dgs
    chi: NonNegative | None = None  # single ones replaced; null: the preset's
    delta: NonNegative | None = None
    gamma: NonNegative | None = None
    gap: AtLeastOne | None = None  # of PDS, in timesteps
    implicit_step: NonNegative | None = None  # length of a step that takes the identity term implicitly; 0: explicitly
    guidance_scale: Number = 7.5  # w_y, of the instruction
    condition_scale: Number = 1.5  # w_I, of the image
    timesteps: str | None = None  # policy (guidance/timesteps.py); null: the rule's own
    schedule_steps: AtLeastOne | None = None  # that the policy goes over, however long the run is; null: max_steps
    reduction: str = "sum"  # as the host's: its other losses are weighted against that
    min_step_percent: Limit | None = None  # lowest noise level, a fraction of T, or a schedule over the host's steps
    max_step_percent: Limit | None = None  # highest
    diffusion_steps: DdimSteps = 20  # of the edits of single images
    set_alpha_to_one: bool = True  # they end without noise; false: with that of timestep 0, as published
    per_editing_step: Count = 10  # of in2n in our own systems; the host's say themselves when they edit
    edit_begin_step: Count = 0
    edit_until_step: Count | None = None
    edit_min_percent: Fraction = 0.02  # in2n: limits of the noise level of an edit, fractions of T
    edit_max_percent: Fraction = 0.98
    noise: str = "independent"  # alternating | paired
    seed: Seed = 0  # of noise and random timesteps

    # --- what a guidance in the host must be told besides
    max_steps: AtLeastOne | None = None  # length of the run, over which decreasing timesteps go: ${trainer.max_steps}
    max_iteration: AtLeastOne | None = None  # its name in the published code
    prompt: str = ""  # words for the prior's own text encoder; empty: the host's prompt processor is asked
    source_prompt: str = ""
    view_dependent_prompting: bool = False  # ask it for the texts of the batch's viewing angles
    loss_name: str = "sds"  # of the loss that is returned, loss_<name>; the YAML must have system.loss.lambda_<name>
    references: str = ""  # a folder of source images in the order of the views' `index`, for systems that pass none
    fixed_size: Annotated[int, Range("[-1, 32766]")] = -1  # pixels a side, to which images are resized; -1: as they are

    # --- the host's names of the prior's options (ALIASES); `prior` goes first
    ip2p_name_or_path: str | None = None
    half_precision_weights: bool | None = None
    enable_sequential_cpu_offload: bool = False
    enable_channels_last_format: bool = False
    freeu_b1: NonNegative | None = None
    freeu_b2: NonNegative | None = None
    freeu_s1: NonNegative | None = None
    freeu_s2: NonNegative | None = None

    # --- WITHOUT_EFFECT
    pretrained_model_name_or_path: Any = None
    ddim_scheduler_name_or_path: Any = None
    cache_dir: Any = None
    enable_memory_efficient_attention: Any = None
    enable_attention_slicing: Any = None
    weighting_strategy: Any = None
    use_sds: Any = None
    use_dds: Any = None
    use_dreamcatalyst: Any = None
    use_sjc: Any = None
    use_img_loss: Any = None
    var_red: Any = None
    grad_clip: Any = None
    sqrt_anneal: Any = None
    control_type: Any = None


def prior_options(cfg: Any) -> dict[str, Any]:
    """The prior's options that a HostConfig says in the host's words, overridden by those that it says in ours."""
    said: dict[str, Any] = {}
    for alias, (option, values) in ALIASES.items():
        given = cfg[alias] if values is None else values.get(cfg[alias])
        if given is None:
            continue
        section, dot, name = option.partition(".")
        if dot:
            said.setdefault(section, {"mode": "paper"})[name] = given  # numbers of FreeU mean that it is on
        else:
            said[option] = given
    return {**said, **cfg.prior}
