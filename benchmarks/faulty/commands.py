"""The command line and the config file: what is typed wrongly, and files that are no config of this project."""

from __future__ import annotations

from .cases import ROOT, Case, Outcome, Place, arguments, case, command

CONFIG = ROOT / "configs/closed-form.yaml"
TYPOS = [  # a key, and what the message must say
    ("dta.source=demo:statue", "'dta'", "'data'"),
    ("data.sorce=demo:statue", "data: unknown key 'sorce'", "'source'"),
    ("data.maxside=24", "data: unknown key 'maxside'", "'max_side'"),
    ("systm.seed=1", "'systm'", "'system'"),
    ("system.gs_sorce=a.ply", "system: unknown key 'gs_sorce'", "'gs_source'"),
    ("system.prompt_procesor.prompt=x", "system: unknown key 'prompt_procesor'", "'prompt_processor'"),
    ("system.prompt_processor.promt=x", "system.prompt_processor: unknown key 'promt'", "'prompt'"),
    ("system.guidance.guidance_scal=2", "system.guidance: unknown key 'guidance_scal'", "'guidance_scale'"),
    ("system.guidance.prior.sigma=2", "system.guidance.prior: unknown key 'sigma'", "Known"),
    ("system.renderer.backen=cpu", "system.renderer: unknown key 'backen'", "'backend'"),
    ("system.learning_rates.mean=1e-4", "system.learning_rates: unknown key 'mean'", "'means'"),
    ("system.densify.evry=10", "system.densify: unknown key 'evry'", "'every'"),
    ("system.mask.knd=box", "system.mask: unknown key 'knd'", "'kind'"),
    ("system.anchor.lambda_colour=1", "system.anchor: unknown key 'lambda_colour'", "'lambda_color'"),
    ("system.report.evry=1", "system.report: unknown key 'evry'", "'every'"),
    ("system.preview.guidance_scale=[1]", "system.preview: unknown key 'guidance_scale'", "'guidance_scales'"),
    ("+system.loss.lambda_guidanc=1", "'+system'", "'system'"),
    ("system.loss.lambda_guidanc=1", "system", "lambda_guidanc"),
    ("trainer.max_step=2", "trainer: unknown key 'max_step'", "'max_steps'"),
    ("checkpoint.save_las=true", "checkpoint: unknown key 'save_las'", "'save_last'"),
    ("promt=snow", "unknown key 'promt'", "Known"),
    ("renderer.backend=cpu", "'renderer'", "system.renderer"),
    ("guidance.rule=sds", "'guidance'", "system.guidance"),
    ("max_steps=100", "'max_steps'", "trainer.max_steps"),
]
NAMES = [  # a name that is not known, and what the message must say
    ("system.guidance.rule=dreamcatalist", "system.guidance", "rule", "'dreamcatalyst'"),
    ("system.guidance.prior_type=instruct-pix2pix", "system.guidance.prior_type", "ip2p"),
    ("system.guidance.preset=papr", "preset", "'paper'"),
    ("system.guidance.timesteps=decresing", "timesteps", "'decreasing'"),
    ("system.guidance.noise=pared", "noise", "'paired'"),
    ("system.guidance.reduction=average", "reduction", "mean"),
    ("system.renderer.backend=gsplatt", "backend", "'gsplat'"),
    ("system.mask.kind=sam", "system.mask", "kind", "text"),
    ("system.mask.vote=majority", "vote", "weighted"),
    ("system.anchor.kind=sorce", "system.anchor", "'source'"),
    ("system.mode=slow", "system.mode", "fast"),
    ("system.nonfinite=ignore", "system.nonfinite", "skip"),
    ("system_type=dreamcatalyst-edit", "system_type", "'dreamcatalyst-edit-system'"),
    ("system_type=dreamfusion-system", "system_type", "dreamcatalyst-edit-system"),
    ("data_type=random-camera-datamodule", "data_type", "dreamcatalyst-data"),
    ("data.source=demo:statute", "demo", "'statue'"),
    ("data.source=captures/bear", "data.source", "captures/bear", "no such file or folder"),
    ("data.format=blender", "data.format", "nerfstudio"),
    ("data.orbit_up=up", "data.orbit_up", "-y"),
    ("trainer.accelerator=cuda:0", "trainer", "cuda:0"),
]


def config_file(content: str | bytes, name: str = "my.yaml"):
    """The command for a config file with this content."""
    return lambda place: ["--config", str(place.write(name, content))]


def kept_word(place: Place, outcome: Outcome) -> list[str]:
    """The last of two values must be in the config that is kept."""
    (parsed,) = place.work.glob("outputs/*/*/configs/parsed.yaml")
    return [] if "\nseed: 2\n" in parsed.read_text() else ["the last value was not taken"]


def folder(place: Place) -> list[str]:
    """A folder where a file is due."""
    (place / "configs/x.yaml").write_text("name: x\n")
    return ["--config", "configs"]


G, F = "command line", "config file"
CASES: list[Case] = [
    *(case("typo", f"{typo}", [typo], *says) for typo, *says in TYPOS),
    *(case("unknown name", name, [name], *says) for name, *says in NAMES),
    command(G, "nothing at all", [], "--config is needed"),
    command(G, "a mode and no config", ["--train"], "--config is needed"),
    command(G, "--config without a file", ["--config"], "--config"),
    command(G, "two modes", ["--config", str(CONFIG), "--train", "--test"], "not allowed with"),
    command(
        G, "--config twice", ["--config", str(ROOT / "configs/fit.yaml"), *arguments("closed-form", [])], "--config"
    ),
    case(G, "a flag with a typo, --trian", ["--trian"], "'--trian' on the command line"),
    case(G, "a flag of another program, --iterations 30000", ["--iterations", "30000"], "'--iterations'"),
    case(G, "--max_steps=5", ["--max_steps=5"], "'--max_steps=5'"),
    case(G, "a prompt without quotes", ["system.prompt_processor.prompt=Make", "it", "snow"], "'it'", "quotes"),
    case(G, "spaces around =", ["seed", "=", "3"], "'seed'"),
    case(G, "a space before =", ["seed =3"], "'seed '"),
    case(G, "a colon in place of =", ["seed:3"], "'seed:3'"),
    case(G, "a value without a key", ["=3"], "'=3'"),
    case(G, "a key with an empty part", ["system..seed=3"], "system..seed"),
    case(G, "a key that ends with a dot", ["system.=3"], "system."),
    case(G, "a list without its end", ["system.preview.guidance_scales=[1,2"], "system.preview.guidance_scales"),
    case(G, "a number for a section, system=5", ["system=5"], "system: got 5"),
    case(G, "a text for a section, data=capture", ["data=capture"], "data: got 'capture'"),
    case(G, "a text for a section, trainer=gpu", ["trainer=gpu"], "trainer: got 'gpu'"),
    case(G, "a bool for a section, checkpoint=true", ["checkpoint=true"], "checkpoint: got True"),
    case(G, "a text for a part, system.mask=box", ["system.mask=box"], "system.mask: got 'box'"),
    case(G, "a key below a number, seed.x=3", ["seed.x=3"], "seed"),
    case(G, "an interpolation to nowhere", ["system.seed=${sead}"], "system.seed", "sead"),
    case(G, "a key that refers to itself", ["seed=${system.seed}"], "seed"),
    case(G, "a key given twice: the last counts", ["seed=1", "seed=2"], "wrote", status=0, check=kept_word, seconds=30),
    case(G, "system.steps without the chosen mode", ["system.steps=null"], "system.steps"),
    case("prompt", "prompt= (nothing)", ["system.prompt_processor.prompt="], "system.prompt_processor"),
    case("prompt", "a prompt of blanks", ["system.prompt_processor.prompt=   "], "system.prompt_processor"),
    case("prompt", "a prompt that is a number", ["system.prompt_processor.prompt=5"], "5"),
    case(
        "prompt", "a prompt that is a list", ["system.prompt_processor.prompt=[a, b]"], "system.prompt_processor.prompt"
    ),
    case(
        "prompt",
        "an instruction that the closed form does not know",
        ["system.prompt_processor.prompt=Add a hat"],
        "Add a hat",
        "sunset",
    ),
    case("prompt", "an instruction with a typo", ["system.prompt_processor.prompt=Make it sunste"], "Make it sunste"),
    case("prompt", "a prompt with a variable, ${HOME}", ["system.prompt_processor.prompt=Make it ${HOME}"], "HOME"),
    case("prompt", "a prompt with a price, ${5}", ["system.prompt_processor.prompt=Costs ${5}"], "Costs ${5}"),
    case("prompt", "a prompt with an open brace, ${", ["system.prompt_processor.prompt=Costs ${"], "Costs ${"),
    case("prompt", "a prompt of 300 characters", ["system.prompt_processor.prompt=" + "snow " * 60], "snow snow"),
    case(
        "prompt", "a prompt of 100,000 characters", ["system.prompt_processor.prompt=" + "snow " * 20000], "snow snow"
    ),
    case("prompt", "a prompt with a NUL byte", ["system.prompt_processor.prompt=a\0b"], "prompt"),
    command(F, "no such file", ["--config", "configs/closed-from.yaml"], "there is no file"),
    command(F, "a folder", folder, "--config", "configs"),
    command(F, "an empty file", config_file(""), "my.yaml", "empty"),
    command(F, "comments only", config_file("# nothing yet\n"), "my.yaml", "empty"),
    command(F, "a list", config_file("- a\n- b\n"), "my.yaml", "list"),
    command(F, "a word", config_file("hello\n"), "my.yaml"),
    command(F, "a number", config_file("5\n"), "my.yaml"),
    command(F, "indented by tabs", config_file("data:\n\tsource: x\n"), "my.yaml:2"),
    command(F, "a bracket that is not closed", config_file("data: {source: x\nseed: 1\n"), "my.yaml:2"),
    command(F, "a key twice", config_file("seed: 1\nseed: 2\n"), "my.yaml", "seed"),
    command(F, "UTF-16", config_file("name: x\n".encode("utf-16")), "my.yaml"),
    command(F, "Latin-1", config_file("name: café\n".encode("latin-1")), "my.yaml"),
    command(F, "a picture", config_file(b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "my.png"), "my.png"),
    command(F, "of another program (compose)", config_file("services:\n  web: {image: x}\n"), "unknown key 'services'"),
    command(F, "of nerfstudio", config_file("!!python/object:nerfstudio.Trainer\nx: 1\n"), "my.yaml"),
    command(
        F, "that would run a program", config_file("a: !!python/object/apply:os.system ['touch run']\n"), "my.yaml"
    ),
    command(
        F,
        "of threestudio's own DreamFusion",
        config_file("name: dreamfusion\nsystem_type: dreamfusion-system\ndata_type: random-camera-datamodule\n"),
        "random-camera-datamodule",
    ),
    command(F, "without system_type and data_type", config_file("name: x\n"), "data_type"),
    command(
        F, "with a value that is left open (???)", ["--config", str(ROOT / "configs/dc-ge-ip2p.yaml")], "data.source"
    ),
    command(
        F, "a checkpoint", lambda place: ["--config", str(place.write("last.ckpt", b"PK\x03\x04\x00\x00"))], "last.ckpt"
    ),
]


def unicode_run(place: Place) -> Outcome:
    """A capture, a PLY and an output folder with spaces and letters of several scripts."""
    from .cases import launched

    place.copy("capture", "Mes photos/été 雪 ❄")
    place.copy("scene.ply", "Mes photos/scène (1).ply")
    given = ["data.source=Mes photos/été 雪 ❄", "system.gs_source=Mes photos/scène (1).ply", "exp_root_dir=Aus gabe/ü"]
    outcome = launched(place, arguments("closed-form", given))
    wanted = list(place.work.glob("Aus gabe/ü/*/*/save/last.ply"))
    outcome.lost = [name for name in outcome.lost if not name.startswith("work/Aus")]
    return outcome if wanted else Outcome(outcome.status, outcome.text, faults=["no result in the folder asked for"])


CASES += [Case("names", "spaces and letters of several scripts in all paths", unicode_run, ("wrote",), 0, 30.0)]


def tagged(name: str, *given: str) -> Case:
    """A folder's name is made of what was typed: the run stays below exp_root_dir, or is refused."""

    def check(place: Place, outcome: Outcome) -> list[str]:
        outside = [path for path in outcome.left if not path.startswith("work/outputs/")]
        return [f"written outside of outputs: {outside[0]}"] if outside else []

    def paths(place: Place) -> list[str]:
        return [word.replace("ELSEWHERE", str(place.root / "elsewhere")) for word in given]

    return case("names", name, paths, "wrote", status=0, check=check, seconds=30)


CASES += [
    tagged("a tag that leads up, ../../x", "tag=../../x"),
    tagged("a tag that is an absolute path", "tag=ELSEWHERE"),
    tagged("a tag of one slash", "tag=/"),
    tagged("a tag of two dots and no time", "tag=..", "use_timestamp=false"),
    tagged("a name that leads up, ../x", "name=../x"),
    tagged("a name that is an absolute path", "name=ELSEWHERE"),
    tagged("a timestamp that leads up", "timestamp=/../../x"),
    tagged("a tag of 300 characters", "tag=" + "long" * 75),
    tagged("a tag of 300 bytes in 100 characters", "tag=" + "雪" * 100),
    tagged("a tag with a line break", "tag=a\nb"),
    tagged("a tag that another system reserves", "tag=a:b*c?"),
    tagged("a tag of quotes", "tag='"),
    case("names", "no tag and no time", ["tag=", "use_timestamp=false"], "tag"),
    case("names", "an empty name", ["name="], "name"),
]
