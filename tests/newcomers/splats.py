"""A splat format of one's own: a line of text for each splat, x y z, its size, its opacity and its colour."""

import numpy as np
import torch
from dreamcatalyst.errors import SceneError
from dreamcatalyst.files import write_text
from dreamcatalyst.scene.formats.api import SPLATS, Found, SplatFormat, with_suffix
from dreamcatalyst.scene.gaussians import Gaussians

MARK = b"# round splats\n"


def read(path, origin):
    try:
        rows = torch.from_numpy(np.loadtxt(path, ndmin=2))
        means, size, opacity, colour = rows.split([3, 1, 1, 3], dim=1)
    except (ValueError, RuntimeError) as error:
        raise SceneError(f"{path}: expected lines of 8 numbers ({error})") from error
    means = (means - means.new_tensor(origin)).float()
    scene = Gaussians.from_colors(means, size.repeat(1, 3).float(), colour.float(), opacity[:, 0].float())
    return Found(scene, ["all splats are round"])


def write(stem, scene, origin, comments, options):
    means, size = scene.means.double() + scene.means.new_tensor(origin), scene.scales.mean(dim=1, keepdim=True)
    colour = scene.sh0[:, 0] * 0.28209479 + 0.5
    rows = torch.cat([means, size, scene.opacities[:, None], colour], dim=1)
    lines = (" ".join(f"{number:.6g}" for number in row) for row in rows.tolist())
    return write_text(with_suffix(stem, ".round"), MARK.decode() + "\n".join(lines) + "\n")


FORMAT = SplatFormat(
    "list of round splats",
    (".round",),
    lambda path, head: head.startswith(MARK),
    read,
    write,
    loses="shapes",
    sh_degree=0,
)
SPLATS.add("round", FORMAT)
