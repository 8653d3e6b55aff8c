"""Which photographs look alike, from their own features: no vocabulary has to be downloaded.

Each photograph is described by its VLAD (Jegou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010): the residuals of its descriptors to the nearest of a few words, summed by word. Words are
k-means centres of the photographs' own descriptors. Square roots and a normalisation by word (Arandjelovic and
Zisserman, "All about VLAD", CVPR 2013) keep repeated structure from outweighing the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Num

WORDS = 64
SAMPLE = 40_000  # descriptors that the words are made of
EACH = 2000  # descriptors of a photograph that describe it, the first ones: SIFT's largest
ROUNDS = 12  # of k-means


def words(descriptors: Sequence[Num[np.ndarray, "_ D"]], seed: int) -> Float[np.ndarray, "W D"]:
    """Centres of the descriptors of all photographs, fewer than WORDS where there are few descriptors."""
    generator = np.random.default_rng(seed)
    share = max(1, SAMPLE // max(1, len(descriptors)))
    parts = [d[generator.permutation(len(d))[:share]] for d in descriptors]
    sample = np.concatenate(parts).astype(np.float32)
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    count = max(1, min(WORDS, len(sample) // 4))
    best: np.ndarray = np.empty(0)
    return cv2.kmeans(sample, count, best, criteria, 1, cv2.KMEANS_RANDOM_CENTERS)[2]


def vlad(descriptors: Num[np.ndarray, "K D"], centres: Float[np.ndarray, "W D"]) -> Float[np.ndarray, " WD"]:
    """One photograph's description, of length 1 (0 where it has no features)."""
    given = descriptors[:EACH].astype(np.float32)
    out = np.zeros_like(centres)
    if len(given):
        squares = (centres**2).sum(axis=1) - 2 * given @ centres.T
        nearest = squares.argmin(axis=1)
        np.add.at(out, nearest, given - centres[nearest])
    out = np.sign(out) * np.sqrt(np.abs(out))
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    return (out / max(float(np.linalg.norm(out)), 1e-9)).ravel()


def likeness(descriptors: Sequence[Num[np.ndarray, "_ D"]], seed: int = 0) -> Float[np.ndarray, "N N"]:
    """How alike photographs are, [N,N] in [-1,1], from the SIFT descriptors [K,128] of each."""
    if not sum(map(len, descriptors)):
        return np.zeros((len(descriptors), len(descriptors)), np.float32)
    centres = words(descriptors, seed)
    described = np.stack([vlad(d, centres) for d in descriptors])
    return described @ described.T
