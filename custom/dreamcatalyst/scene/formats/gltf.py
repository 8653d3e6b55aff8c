"""glTF 2.0 with KHR_gaussian_splatting: floats, scales and opacities as they are drawn, a point cloud for viewers that
do not know splats.

Quaternions are xyzw; SH coefficients are one attribute each, in the order and with the signs of 3DGS; colours are sRGB
as displayed. Axes are left, up, forward: the PLY's (right, down, forward) turned by half a turn about z. Source: the
extension's text (Khronos, release candidate). Splats packed by KHR_gaussian_splatting_compression_spz_2 are read, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...data.origin import ZERO, Origin
from ...errors import SceneError
from ...files import replacing, write_text
from ..gaussians import Gaussians
from ..place import Similarity, moved, with_degree
from . import spz
from .api import Found, SplatFormat, require_room, with_suffix
from .gltffile import MAGIC, GltfFile, glb
from .quantized import REST, Signs, assembled, color_bytes, opacity_bytes, turned, unit

KHR, PACKED = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"
TURNED: Signs = (-1, -1, 1)
DRAWN = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
DRAWN["sortingMethod"] = "cameraDistance"
FLOAT, BYTE, ARRAY, POINTS = 5126, 5121, 34962, 0
SMALLEST, NEAR = 1e-30, 2.0**-25  # of a scale; of an opacity to 0 or 1: their logarithms are to be finite


@dataclass(frozen=True)
class GltfOptions:
    """How a glTF is written."""

    separate: bool = False  # .gltf and .bin, instead of one .glb


def detect(path: Path, head: bytes) -> bool:
    start = head.lstrip(b" \t\r\n\xef\xbb\xbf")
    return head.startswith(MAGIC) or (start.startswith(b"{") and path.suffix.lower() == ".gltf")


# --- reading


def read(path: Path, origin: Origin) -> Found:
    file = GltfFile(path)
    parts, notices = [], []
    for matrix, primitive in file.instances():
        extension = (primitive.get("extensions") or {}).get(KHR)
        if isinstance(extension, dict):
            parts.append(_placed(path, _splats(file, primitive, extension, notices), matrix, origin))
    if not parts:
        raise SceneError(f"{path}: is a glTF without splats: no mesh in its scene has {KHR}. A mesh: system.mesh=")
    degree = max(part.sh_degree for part in parts)
    return Found(Gaussians.cat([with_degree(part, degree) for part in parts]) if parts[1:] else parts[0], notices)


def comments(path: Path) -> list[str]:
    extras = GltfFile(path).tree["asset"].get("extras")
    listed = extras.get("comments") if isinstance(extras, dict) else None
    return [line for line in listed if isinstance(line, str)] if isinstance(listed, list) else []


def _splats(file: GltfFile, primitive: dict[str, Any], extension: dict[str, Any], notices: list[str]) -> Gaussians:
    """A primitive's splats in its own space."""
    packed = (extension.get("extensions") or {}).get(PACKED)
    if isinstance(packed, dict):
        return spz.decode(file.path, bytes(file.view(packed.get("bufferView"))), ZERO, (1, 1, 1)).scene
    kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", DRAWN["colorSpace"])
    if kernel != "ellipse":
        raise SceneError(f"{file.path}: its splats have the kernel '{kernel}', expected ellipse")
    if space != DRAWN["colorSpace"]:
        notices.append(f"its colours are {space}; they are drawn as sRGB")
    attributes = primitive.get("attributes") or {}

    def numbers(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise SceneError(f"{file.path}: its splats have no attribute {name} (found {', '.join(attributes)})")
        return file.accessor(attributes[name], width)

    means, quats = numbers("POSITION", 3), numbers(f"{KHR}:ROTATION", 4)
    count = len(means)
    require_room(file.path, count)
    degree = max((d for d in REST if f"{KHR}:SH_DEGREE_{d}_COEF_0" in attributes), default=0)
    names = [f"{KHR}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    shN = np.empty((count, len(names) - 1, 3), np.float32)
    scales, opacities = numbers(f"{KHR}:SCALE", 3), numbers(f"{KHR}:OPACITY", 1)[:, 0]
    sh0, *columns = [numbers(name, 3) for name in names]
    lengths = {len(column) for column in (means, quats, scales, opacities, sh0, *columns)}
    if lengths != {count} or count == 0:
        raise SceneError(
            f"{file.path}: its attributes have {sorted(lengths)} rows, expected one number of them, over 0"
        )
    for start in range(0, count, 4096):  # attribute by attribute misses the cache
        rows = slice(start, start + 4096)
        for place, column in enumerate(columns):
            shN[rows, place] = column[rows]
    if not (scales >= 0).all() or not ((opacities >= 0) & (opacities <= 1)).all():
        raise SceneError(f"{file.path}: has negative scales, or opacities outside of 0 to 1")
    opacities = np.clip(opacities.astype(np.float64), NEAR, 1 - NEAR)
    return assembled(
        means,
        unit(quats.astype(np.float32)[:, [3, 0, 1, 2]]),
        np.log(np.maximum(scales, np.float32(SMALLEST))),
        np.log(opacities / (1 - opacities)),
        sh0,
        shN,
        ZERO,
    )


def _placed(path: Path, scene: Gaussians, matrix: np.ndarray, origin: Origin) -> Gaussians:
    """The splats where their node puts them, in the PLY's axes and counted from `origin`."""
    turn = np.diag([*TURNED, 1.0]) @ matrix
    size = np.linalg.norm(turn[:3, :3], axis=0)
    if not np.allclose(size, size[0], rtol=1e-4) or not size[0] > 0:
        raise SceneError(f"{path}: a node stretches its splats by {size.tolist()}, expected one scale for all axes")
    means = scene.means.double().numpy() @ turn[:3, :3].T + turn[:3, 3] - origin
    rotation = turn[:3, :3] / size
    right, down, forward = (int(sign) for sign in np.rint(np.diagonal(rotation)))
    if np.allclose(rotation, np.diag([right, down, forward]), atol=1e-6):
        scene = turned(scene, (right, down, forward))
    elif np.linalg.det(rotation) > 0:
        scene = moved(scene, Similarity(torch.from_numpy(rotation), 1.0, torch.zeros(3, dtype=torch.float64)))
    else:
        raise SceneError(f"{path}: a node mirrors its splats, which glTF leaves undefined; apply it before exporting")
    if size[0] != 1:
        scene = replace(scene, log_scales=scene.log_scales + float(np.log(size[0])))
    return replace(scene, means=torch.from_numpy(means.astype(np.float32)))


# --- writing


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: GltfOptions) -> Path:
    scene = turned(scene, TURNED)
    sh0, logits = scene.sh0[:, 0].float().numpy(), scene.logit_opacities.float()
    columns: list[tuple[str, np.ndarray]] = [
        ("POSITION", scene.means.float().numpy()),
        ("COLOR_0", np.concatenate([color_bytes(sh0), opacity_bytes(logits.numpy())[:, None]], axis=1)),
        (f"{KHR}:ROTATION", unit(scene.quats.float().numpy())[:, [1, 2, 3, 0]]),
        (f"{KHR}:SCALE", scene.log_scales.float().exp().numpy()),
        (f"{KHR}:OPACITY", logits.sigmoid().numpy()[:, None]),
        (f"{KHR}:SH_DEGREE_0_COEF_0", sh0),
    ]
    for d in range(1, scene.sh_degree + 1):
        for n in range(2 * d + 1):
            columns.append((f"{KHR}:SH_DEGREE_{d}_COEF_{n}", scene.shN[:, REST[d - 1] + n].float().numpy()))
    tree = _tree(columns, (np.array(origin) * TURNED).tolist(), comments)
    size = tree["buffers"][0]["byteLength"]
    path = with_suffix(stem, ".gltf" if options.separate else ".glb")
    data = with_suffix(stem, ".bin") if options.separate else path
    with replacing(data) as part, part.open("wb") as file:
        if not options.separate:
            file.write(glb(tree, size))
        for _, column in columns:
            file.write(np.ascontiguousarray(column).view(np.uint8).data)
    if options.separate:
        tree["buffers"][0]["uri"] = data.name
        write_text(path, json.dumps(tree))
    return path


def _tree(columns: list[tuple[str, np.ndarray]], place: list[float], comments: Sequence[str]) -> dict[str, Any]:
    """The JSON of one mesh at `place`, its attributes one after the other in the buffer."""
    views, accessors, at = [], [], 0
    for name, column in columns:
        size = column.size * column.itemsize
        views.append({"buffer": 0, "byteOffset": at, "byteLength": size, "target": ARRAY})
        kind = "SCALAR" if column.shape[1] == 1 else f"VEC{column.shape[1]}"
        accessor: dict[str, Any] = {"bufferView": len(accessors), "count": len(column), "type": kind}
        accessor["componentType"] = BYTE if column.dtype == np.uint8 else FLOAT
        if column.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": column.min(axis=0).tolist(), "max": column.max(axis=0).tolist()}
        accessors.append(accessor)
        at += size
    node: dict[str, Any] = {"mesh": 0}
    if any(place):
        node["translation"] = place
    attributes = {name: index for index, (name, _) in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {KHR: DRAWN}}
    asset: dict[str, Any] = {"version": "2.0", "generator": "dreamcatalyst"}
    if comments:
        asset["extras"] = {"comments": list(comments)}
    return {
        "asset": asset,
        "extensionsUsed": [KHR],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }


FORMAT = SplatFormat(
    "glTF (KHR_gaussian_splatting)",
    (".glb", ".gltf"),
    detect,
    read,
    write,
    GltfOptions,
    loses="the last digit of scales and opacities",
    comments=comments,
    implied={".gltf": {"separate": True}},
)
