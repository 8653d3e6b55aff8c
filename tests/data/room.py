"""A room whose cameras are known, three textured walls drawn by casting rays: for structure from motion."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from dreamcatalyst.data.camera import Cameras, look_at

WALLS = ((0, -2.0), (1, 2.0), (2, 0.0))  # axis, place: a corner of a room, z up
TEXTURE, REACH = 512, 6.0  # pixels, and the world units that they span


def textures(seed: int = 0) -> list[np.ndarray]:
    """For each wall a heap of rectangles of all sizes: sharp corners at every scale."""
    rng, made = np.random.default_rng(seed), []
    for _ in WALLS:
        image = np.full((TEXTURE, TEXTURE, 3), 128, np.uint8)
        for size in np.geomspace(120, 5, 900):
            x, y = rng.integers(0, TEXTURE, 2)
            w, h = (rng.uniform(0.4, 1.0, 2) * size).astype(int)
            cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 255, 3).tolist(), -1)
        made.append(image)
    return made


def arc(n: int, degrees: float = 50.0, radius: float = 4.5) -> torch.Tensor:
    """World-to-camera matrices [n,4,4] on an arc before the corner, at heights that differ."""
    angle = torch.linspace(-degrees / 2, degrees / 2, n, dtype=torch.float64) * torch.pi / 180 - torch.pi / 4
    height = 1.6 + 0.3 * torch.sin(torch.arange(n, dtype=torch.float64))
    eye = torch.stack([-2 + radius * angle.cos(), 2 + radius * angle.sin(), height], 1)
    return look_at(eye, torch.tensor([-1.5, 1.5, 0.8]).double(), torch.tensor([0, 0, 1.0]).double())


def turned(n: int, degrees: float = 40.0) -> torch.Tensor:
    """Matrices of a camera that is turned and stays where it is."""
    eye = torch.tensor([1.0, -1.0, 1.5]).double().repeat(n, 1)
    angle = torch.linspace(-degrees / 2, degrees / 2, n, dtype=torch.float64) * torch.pi / 180 + 3 * torch.pi / 4
    target = eye + torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, -0.2)], 1)
    return look_at(eye, target, torch.tensor([0, 0, 1.0]).double())


def cameras(viewmats: torch.Tensor, width: int = 320, height: int = 240) -> Cameras:
    """Pinholes of 65 degrees."""
    f = width / 2 / np.tan(np.radians(65 / 2))
    K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]).double()
    return Cameras(viewmats, K.repeat(len(viewmats), 1, 1), width, height)


def draw(views: Cameras, walls: list[np.ndarray] | None = None) -> list[np.ndarray]:
    """BGR pictures [H,W,3] uint8, four rays to a pixel."""
    walls = textures() if walls is None else walls
    y, x = np.mgrid[0 : 2 * views.height, 0 : 2 * views.width] / 2 + 0.25
    pictures = []
    for viewmat, K, eye in zip(views.viewmats.numpy(), views.Ks.numpy(), views.centers.numpy(), strict=True):
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ viewmat[:3, :3]
        nearest = np.full(x.shape, np.inf)
        image = np.zeros((*x.shape, 3), np.uint8)
        for (axis, place), texture in zip(WALLS, walls, strict=True):
            away = (place - eye[axis]) / rays[..., axis]
            hit = (eye + rays * away[..., None])[..., [a for a in range(3) if a != axis]]
            where = ((hit + REACH / 2) / REACH * TEXTURE).astype(np.float32)
            seen = cv2.remap(texture, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
            front = (away > 0) & (away < nearest)
            image[front], nearest[front] = seen[front], away[front]
        pictures.append(cv2.resize(image, (views.width, views.height), interpolation=cv2.INTER_AREA))
    return pictures


def photographs(folder: Path, viewmats: torch.Tensor, size: tuple[int, int] = (320, 240)) -> Path:
    """`folder` with 00.jpg, 01.jpg ... of the room."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, picture in enumerate(draw(cameras(viewmats, *size))):
        cv2.imwrite(str(folder / f"{i:02d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def video(path: Path, viewmats: torch.Tensor, blurred: tuple[int, ...] = ()) -> Path:
    """A video of the room at 25 frames per second, `blurred` some of its frames."""
    written = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (320, 240))
    for i, picture in enumerate(draw(cameras(viewmats))):
        written.write(cv2.GaussianBlur(picture, (0, 0), 4) if i in blurred else picture)
    written.release()
    return path


def errors(centres: np.ndarray, rotations: np.ndarray, truth: Cameras) -> tuple[float, float]:
    """The largest error of centres [V,3], as a share of the true cameras' extent, and of rotations [V,3,3] in degrees,
    after the best similarity (Umeyama 1991)."""
    true, true_rotations = truth.centers.double().numpy(), truth.viewmats[:, :3, :3].double().numpy()
    a, b = centres - centres.mean(0), true - true.mean(0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1, 1, np.linalg.det(U @ Vt)])
    R, scale = U @ D @ Vt, (S * np.diag(D)).sum() / (a**2).sum()
    away = np.linalg.norm(scale * a @ R.T - b, axis=1).max() / np.linalg.norm(b, axis=1).max()
    traces = np.einsum("vij,vij->v", rotations @ R.T, true_rotations)
    return float(away), float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))).max())
