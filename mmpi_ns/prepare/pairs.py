"""Choice of image pairs for matching: neighbours in time, neighbours in pose, similar images, or all.

Similar images are found by VLAD (residuals of SIFT descriptors to the words of a small vocabulary, summed by word). The
vocabulary is made from the capture itself, so nothing is downloaded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

Matching = Literal["auto", "sequential", "exhaustive", "retrieval"]
FEW = 40
"""Up to this many images are matched exhaustively, whatever their order."""
MANY = 120
"""More unordered images than this are matched with similar ones only."""
WORDS, SAMPLE, FEATURES = 64, 20_000, 800
"""Vocabulary size, descriptors it is learnt from, and descriptors of an image that are summed."""
REVISITS = 3
"""Similar images that each image of a sequence is matched with besides its neighbours in time."""
LOOK_ALIKES = 30
"""Similar images that each image of a large unordered set is matched with."""
FAR_STEPS = (15, 20, 30, 45)
"""Frame distances beyond the overlap that are matched too, because slow stretches need a longer baseline."""

Pairs = list[tuple[int, int]]


def describe_images(database: Path, count: int, seed: int = 0) -> NDArray[np.float32]:
    """One unit vector for each image; the dot product of two is their similarity. [count, WORDS * 128]"""
    rng = np.random.default_rng(seed)
    with pycolmap.Database.open(database) as opened:

        def sample(image: int, number: int) -> NDArray[np.float32]:
            rows = np.asarray(opened.read_descriptors(image + 1).data).reshape(-1, 128)
            kept = rows[np.sort(rng.choice(len(rows), min(number, len(rows)), replace=False))] if len(rows) else rows
            return np.sqrt(kept.astype(np.float32) / 512)

        words = _vocabulary(np.concatenate([sample(i, max(20, SAMPLE // count)) for i in range(count)]), rng)
        return np.stack([_vlad(sample(i, FEATURES), words) for i in range(count)])


def _vocabulary(descriptors: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """k-means. [WORDS, 128]"""
    words = descriptors[rng.choice(len(descriptors), WORDS, replace=len(descriptors) < WORDS)]
    for _ in range(8):
        nearest = _nearest(descriptors, words)
        counts = np.bincount(nearest, minlength=WORDS)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, descriptors)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    return words


def _nearest(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    return (-2 * descriptors @ words.T + (words**2).sum(-1)).argmin(-1)


def _vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest = _nearest(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=-1, keepdims=True), 1e-9)
    return (sums / max(float(np.linalg.norm(sums)), 1e-9)).reshape(-1)


def similarity(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Similarity of any two images; -1 on the diagonal. [N, N]"""
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, -1)
    return alike


def are_numbered(names: Sequence[str]) -> bool:
    """Whether names differ only in one number, like frames of a video."""
    stems = [Path(n).stem for n in names]
    patterns = {re.sub(r"\d+", "#", s) for s in stems}
    last = [re.findall(r"\d+", s) for s in stems]
    varying = {i for row in last for i in range(len(row)) if row[i] != last[0][i]} if len(patterns) == 1 else set()
    return len(varying) == 1


def look_like_sequence(alike: NDArray[np.float32]) -> bool:
    """Whether most images are most similar to one of the three before or after them."""
    best = alike.argmax(-1)
    return float(np.mean(np.abs(best - np.arange(len(alike))) <= 3)) > 0.7


def choose(matching: Matching, names: Sequence[str], alike: NDArray[np.float32], from_video: bool) -> tuple[str, str]:
    """(matching, why in words)."""
    if matching != "auto":
        return matching, "as asked"
    count = len(names)
    if count <= FEW:
        return "exhaustive", f"{count} images are few"
    if from_video:
        return "sequential", "frames of a video"
    if are_numbered(names) and look_like_sequence(alike):
        return "sequential", "numbered frames that look like their neighbours"
    if count <= MANY:
        return "exhaustive", f"{count} images in no order"
    return "retrieval", f"{count} images in no order are too many to match all"


def list_pairs(matching: str, alike: NDArray[np.float32], overlap: int) -> Pairs:
    """Pairs (i < j) for a way of matching."""
    count = len(alike)
    if matching == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    if matching == "retrieval":
        return _look_alikes(alike, LOOK_ALIKES, np.zeros_like(alike, dtype=bool))
    steps = [*range(1, overlap + 1), *(s for s in FAR_STEPS if s > overlap)]
    near = {(i, i + s) for s in steps for i in range(count - s)}
    return sorted(near | set(revisits(alike, overlap)))


def revisits(alike: NDArray[np.float32], overlap: int) -> Pairs:
    """Pairs of a sequence that may show a place again: as similar as images a few frames apart."""
    apart = np.abs(np.subtract.outer(np.arange(len(alike)), np.arange(len(alike))))
    near = apart <= max(FAR_STEPS[-1], overlap)
    edge = alike[apart == min(overlap, len(alike) - 1)]
    return _look_alikes(alike, REVISITS, near | (alike < np.percentile(edge, 25)))


def _look_alikes(alike: NDArray[np.float32], number: int, barred: NDArray[np.bool_]) -> Pairs:
    """Each image with the most similar other images."""
    allowed = np.where(barred | np.eye(len(alike), dtype=bool), -np.inf, alike)
    order = np.argsort(-allowed, axis=-1, kind="stable")[:, :number]
    found = {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(order) for j in row if np.isfinite(allowed[i, j])}
    return sorted(found)
