"""A capture format of one's own: a text file of eyes, one a line, that all look at the origin."""

import numpy as np
import torch
from dreamcatalyst.data.camera import look_at
from dreamcatalyst.data.formats import FORMATS, Format, Scan, Shot
from dreamcatalyst.data.lens import Lens


def find(source):
    path = source / "eyes.txt"
    return path if path.is_file() else None


def read(path, options):
    eyes = torch.from_numpy(np.loadtxt(path, ndmin=2))
    viewmats = look_at(eyes, eyes.new_zeros(3), eyes.new_tensor([0.0, 0.0, 1.0]))
    lens = Lens(fx=80.0, fy=80.0, cx=32.0, cy=32.0, width=64, height=64)
    return Scan([Shot(f"eye-{i}", viewmat.numpy(), lens, None) for i, viewmat in enumerate(viewmats)])


FORMATS.add("eyes", Format("eyes.txt", find, read))
