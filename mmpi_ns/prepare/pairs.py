"""Choice of image pairs for matching: neighbours in time, similar images, or all.

Similar images are found by VLAD (residuals of SIFT descriptors to the words of a small vocabulary, summed by word). The
vocabulary is made from the capture itself, so nothing is downloaded. COLMAP's own pair generators do not serve: that of
sequences sorts names as text (10.jpg before 2.jpg), that of poses does not ask whether two cameras face the same way.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

Matching = Literal["auto", "sequential", "exhaustive", "retrieval"]
FEW = 40
"""Up to this many images are matched exhaustively, whatever their order."""
MANY = 120
"""More unordered images than this are matched with similar ones only."""
WORDS, SAMPLE, FEATURES, ROUNDS = 64, 20_000, 800, 8
"""Vocabulary size, descriptors it is learnt from, descriptors of an image that are summed, and rounds of k-means."""
REVISITS = 3
"""Similar images that each image of a sequence is matched with besides its neighbours in time."""
LOOK_ALIKES = 30
"""Similar images that each image of a large unordered set is matched with."""
FAR_STEPS = (15, 20, 30, 45)
"""Frame distances beyond the overlap that are matched too, because slow stretches need a longer baseline."""

Pairs = list[tuple[int, int]]


def image_similarity(database: Path, count: int) -> NDArray[np.float32]:
    """Similarity of any two images by their features, at most 1; -1 on the diagonal. [count, count]

    Source: Jegou et al., Aggregating local descriptors into a compact image representation (2010), with root SIFT.
    """
    rng = np.random.default_rng(0)
    vectors = np.zeros((count, WORDS, 128), dtype=np.float32)
    with pycolmap.Database.open(database) as opened:

        def sample(image: int, number: int) -> NDArray[np.float32]:
            rows = np.asarray(opened.read_descriptors(image + 1).data).reshape(-1, 128)
            kept = rows[np.sort(rng.choice(len(rows), min(number, len(rows)), replace=False))] if len(rows) else rows
            return np.sqrt(kept.astype(np.float32) / 512)

        descriptors = np.concatenate([sample(i, max(20, SAMPLE // count)) for i in range(count)])
        words = descriptors[rng.choice(len(descriptors), WORDS, replace=len(descriptors) < WORDS)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of few descriptors, words may be empty
            words, _ = kmeans2(descriptors, words, ROUNDS, minit="matrix")
        for i, vector in enumerate(vectors):
            descriptors = sample(i, FEATURES)
            if len(descriptors):
                nearest, _ = vq(descriptors, words)
                np.add.at(vector, nearest, descriptors - words[nearest])
    vectors /= np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    flat = vectors.reshape(count, -1)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    alike = flat @ flat.T
    np.fill_diagonal(alike, -1)
    return alike


def are_numbered(names: Sequence[str]) -> bool:
    """Whether names differ only in one number, like frames of a video."""
    stems = [Path(n).stem for n in names]
    patterns = {re.sub(r"\d+", "#", s) for s in stems}
    last = [re.findall(r"\d+", s) for s in stems]
    varying = {i for row in last for i in range(len(row)) if row[i] != last[0][i]} if len(patterns) == 1 else set()
    return len(varying) == 1


def choose(matching: Matching, names: Sequence[str], alike: NDArray[np.float32], from_video: bool) -> tuple[str, str]:
    """Way of matching, and the reason in words."""
    count = len(names)
    if matching != "auto":
        return matching, "as asked"
    if count <= FEW:
        return "exhaustive", f"{count} images are few"
    if from_video:
        return "sequential", "frames of a video"
    nearest_in_time = np.abs(alike.argmax(-1) - np.arange(count)) <= 3
    if are_numbered(names) and nearest_in_time.mean() > 0.7:
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
        return _look_alikes(alike, LOOK_ALIKES)
    steps = [*range(1, overlap + 1), *(s for s in FAR_STEPS if s > overlap)]
    near = {(i, i + s) for s in steps for i in range(count - s)}
    return sorted(near | set(revisits(alike, overlap)))


def revisits(alike: NDArray[np.float32], overlap: int) -> Pairs:
    """Pairs of a sequence that may show a place again: as similar as images a few frames apart."""
    apart = np.abs(np.subtract.outer(np.arange(len(alike)), np.arange(len(alike))))
    edge = alike[apart == min(overlap, len(alike) - 1)]
    usable = (apart > max(FAR_STEPS[-1], overlap)) & (alike >= np.percentile(edge, 25))
    return _look_alikes(np.where(usable, alike, -np.inf), REVISITS)


def _look_alikes(alike: NDArray[np.float32], number: int) -> Pairs:
    """Pairs of each image and the images most similar to it; infinite similarities do not count."""
    alike = np.where(np.eye(len(alike), dtype=bool), -np.inf, alike)
    order = np.argsort(-alike, axis=-1, kind="stable")[:, :number]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(order) for j in row if alike[i, j] > -1e9})
