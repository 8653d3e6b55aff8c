"""Values out of range, of another kind or in another unit, key by key: each is refused by its key's name."""

from __future__ import annotations

from .cases import Case, case

RATES = ("means", "quats", "scales", "opacities", "sh0", "shN")
# key: values that are refused. A run by such a value would train nothing, or wrongly, without a word.
EDIT: dict[str, tuple[str, ...]] = {
    "seed": ("-1", "abc", "1.5", "99999999999999999999", "true"),
    "data.max_side": ("0", "-5", "big", "1.5", "null]"),
    "data.width": ("0", "-512", "512px", "nan"),
    "data.downscale": ("nan", "0", "0.5", "-2", "inf"),
    "data.test_every": ("-1", "1", "x"),
    "data.max_view_num": ("0", "-3"),
    "data.batch_size": ("0", "-1", "two"),
    "data.resident_gib": ("-1", "nan"),
    "data.background": ("[0,0,2]", "[0,0]", "white", "[nan,0,0]", "0.5"),
    "system.learning_rates.warm_up_steps": ("-5", "1.5"),
    "system.learning_rates.means_decay": ("0", "-0.1", "2", "nan"),
    "system.learning_rates.decay": ("0", "nan"),
    "system.learning_rates.beta2": ("1", "-0.1", "nan"),
    "system.learning_rates.means": ("-1e-4", "nan", "inf", "1,6e-4", "fast", "[1,2]", "[0,1e-3,1e-4,-5]", "null"),
    "system.densify.every": ("-1", "1.5", "often"),
    "system.densify.start": ("-1",),
    "system.densify.stop": ("-1",),
    "system.densify.grad_threshold": ("-1", "nan"),
    "system.densify.top_fraction": ("-0.1", "1.5", "nan", "50%"),
    "system.densify.dense_size": ("-1", "nan"),
    "system.densify.min_opacity": ("-0.1", "2", "nan"),
    "system.densify.max_size": ("-1", "nan"),
    "system.densify.max_radius": ("-1", "nan"),
    "system.densify.max_splats": ("-1", "many"),
    "system.densify.reset_every": ("-1",),
    "system.guidance.chi": ("-1", "nan", "inf"),
    "system.guidance.delta": ("nan",),
    "system.guidance.gamma": ("nan",),
    "system.guidance.guidance_scale": ("nan", "inf", "[1,2]", "strong"),
    "system.guidance.condition_scale": ("nan", "[1,2]"),
    "system.guidance.max_step_percent": ("90", "-0.1", "0", "nan"),
    "system.guidance.min_step_percent": ("0.9", "-1", "nan"),
    "system.guidance.implicit_step": ("-1", "nan"),
    "system.guidance.diffusion_steps": ("-5", "0"),
    "system.guidance.per_editing_step": ("-1",),
    "system.guidance.edit_max_percent": ("98", "nan"),
    "system.guidance.prior.s": ("0", "-1", "nan"),
    "system.loss": ("{lambda_guidance: -1}", "{lambda_guidance: nan}", "{lambda_perceptual: 10}", "[]"),
    "system.renderer.background": ("[2,0,0]", "black", "[0,0]", "[nan,0,0]"),
    "system.renderer.cache_mib": ("-1",),
    "system.renderer.antialiased": ("maybe",),
    "system.source_cache_mib": ("-1", "lots"),
    "system.report.every": ("-1",),
    "system.report.views": ("0",),
    "system.report.overhead": ("nan", "-1"),
    "system.report.video_fps": ("0",),
    "system.report.video_frames": ("-1", "1e3x"),
    "system.report.clip_source": ("a bear",),
    "system.preview.guidance_scales": ("5", "[a]", "[nan]"),
    "system.drop_nonfinite": ("maybe",),
    "trainer.max_steps": ("0", "-1", "true", "1.5", "abc", "null", "[5]", "1_000x"),
    "trainer.limit_train_batches": ("1", "0"),
    "trainer.overfit_batches": ("1",),
    "trainer.strategy": ("ddp", "fast"),
    "trainer.devices": ("2", "0", "-1", "gpu"),
    "trainer.precision": ("8", "half"),
    "trainer.accelerator": ("tpu", "gpu", "none"),
    "trainer.max_epochs": ("0", "-5"),
    "trainer.val_check_interval": ("0", "-1"),
    "trainer.max_time": ("soon",),
    "checkpoint.every_n_train_steps": ("-1", "x"),
    "checkpoint.save_top_k": ("-5",),
}
FIT: dict[str, tuple[str, ...]] = {
    "system.ssim_weight": ("-0.1", "1.5", "nan"),
    "system.initial_opacity": ("0", "1", "2", "nan"),
    "system.mesh_points": ("0", "-1"),
    "system.sh_degree": ("4", "-1", "1.5"),
    "system.sh_every": ("-1",),
}
MASK: dict[str, tuple[str, ...]] = {  # with a box around everything
    "threshold": ("0", "2", "nan", "-0.5", "50"),
    "feather": ("-1", "nan", "inf"),
    "grow": ("-1", "nan"),
    "views": ("0", "-1"),
    "neighbours": ("0",),
    "min_evidence": ("-1", "nan"),
}
ANCHOR = ("weight_init", "weight_init_g0", "weight_multiplier", "max_weight", "lambda_geo", "lambda_color")
BOX = ["system.mask.kind=box", "system.mask.options={low: [-9, -9, -9], high: [9, 9, 9]}"]


def blamed(key: str) -> str:
    """The text that a message must hold: the last part of the key; of Lightning's own checks, the section."""
    section, _, last = key.rpartition(".")
    return section if section in ("trainer", "checkpoint") and last != "max_steps" else last


def refused(key: str, value: str, *before: str, config: str = "closed-form") -> Case:
    """`key=value` is refused by a line that names the key."""
    return case("value", f"{key}={value}", [*before, f"{key}={value}"], blamed(key), config=config)


CASES: list[Case] = [
    *(refused(key, value) for key, values in EDIT.items() for value in values),
    *(refused(f"system.learning_rates.{rate}", value) for rate in RATES[1:] for value in ("-1e-3", "nan")),
    *(refused(key, value, config="fit") for key, values in FIT.items() for value in values),
    *(refused(f"system.mask.{key}", value, *BOX) for key, values in MASK.items() for value in values),
    *(
        refused(f"system.anchor.{key}", value, "system.anchor.kind=last-densify")
        for key in ANCHOR
        for value in ("-1", "nan")
    ),
    case(
        "value",
        "densify.stop before densify.start",
        ["system.densify.every=1", "system.densify.start=100", "system.densify.stop=1"],
        "densify.stop ends it at 1",
        status=0,
        seconds=30,
    ),
    case(
        "value",
        "edit_min_percent above edit_max_percent",
        ["system.guidance.edit_min_percent=0.9", "system.guidance.edit_max_percent=0.1"],
        "edit_min_percent",
    ),
    case(
        "value", "downscale and width together", ["data.downscale=2", "data.width=64"], "data.downscale", "data.width"
    ),
    case("value", "a million pixels a side", ["data.width=1000000", "data.height=1000000"], "data.width"),
    case("value", "a million views in a step", ["data.batch_size=1000000"], "data.batch_size"),
    case(
        "value",
        "a million cameras around the splats",
        lambda place: [f"system.gs_source={place.copy('scene.ply').name}", "data.source=", "data.orbit_views=1000000"],
        "data.orbit_views",
    ),
    case(
        "value", "a view to preview that is not there", ["--preview", "system.preview.view=1000"], "system.preview.view"
    ),
    case("value", "a million frames of video", ["system.report.video_frames=1000000000"], "video_frames"),
    case(
        "value",
        "anchors without densification or source, of an unknown weight",
        ["system.anchor.kind=last-densify", "system.anchor.weight_init=heavy"],
        "weight_init",
    ),
    case("value", "an option of a mask without a kind", ["system.mask.options={folder: masks}"], "system.mask"),
    case("value", "perceptual loss without weights", ["system.loss={lambda_perceptual: 10}"], "perceptual_weights"),
]
