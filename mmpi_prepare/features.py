"""Features of the images, pairs to match, and their matches, in a COLMAP database that a resumed run fills further.

Pairs are neighbours in time, similar images, or all. Similar images are found by VLAD (residuals of SIFT descriptors to
the words of a small vocabulary, summed by word). The vocabulary is made from the capture itself, so nothing is
downloaded. COLMAP's own pair generators do not serve: that of sequences sorts names as text (10.jpg before 2.jpg), that
of poses does not ask whether two cameras face the same way.
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

from mmpi_ns.utils.errors import InputError, progress
from mmpi_ns.utils.files import whole
from mmpi_prepare.images import Photo
from mmpi_priors.sfm import MIN_INLIERS, count_features, find_features, new_model, write_images

DATABASE = "database.db"
"""Name of a database in its folder."""
BATCH, PAIR_BATCH = 8, 64
"""Images extracted, and pairs matched, at a time: the most that an interruption loses."""
LARGEST_SIDE = 2000
"""Larger images are reduced to this side for SIFT."""
PIXELS_A_FEATURE, LEAST_FEATURES = 100, 2048
"""At most one feature for this many pixels, but small images may have the second number: more are redundant, and the
cost of matching is quadratic."""
FAINT, SAMPLE = 0.003, 4
"""SIFT's peak threshold for images with few features: weak ones count too; and images looked at to find whether they
have few."""
FEATURES = 50
"""An image with fewer is of no use."""
Matching = Literal["auto", "sequential", "exhaustive", "retrieval"]
FEW, MANY = 40, 120
"""Up to the first number images are matched exhaustively, whatever their order; more unordered ones than the second
with similar ones only."""
WORDS, WORDS_FROM, SUMMED, ROUNDS = 64, 20_000, 800, 8
"""Vocabulary size, descriptors it is learnt from, descriptors of an image that are summed, and rounds of k-means."""
REVISITS, LOOK_ALIKES = 3, 30
"""Similar images that each image of a sequence, besides its neighbours, and of a large unordered set is matched
with."""
FAR_STEPS = (15, 20, 30, 45)
"""Frame distances beyond the overlap that are matched too, because slow stretches need a longer baseline."""

Pairs = list[tuple[int, int]]
NEXT, IN_ORDER = 3, 0.7
"""Numbered images are in the order of the motion if more than this share of them look most like one of so many before
and after, and share the most matches with the one before or after: in sequences all do, of 25 photos round a table that
were taken in parts 0.4 do, and 0.8 with one of three."""


def extract(
    images: Path,
    photos: Sequence[Photo],
    cameras: tuple[Sequence[int], Sequence[pycolmap.Camera]],
    masks: Path | None,
    max_features: int,
    threads: int,
    folder: Path,
) -> None:
    """SIFT features of all images, in the database of a folder; images that have theirs are skipped.

    The database is made if it is missing, with ``cameras``: the number of each image's, and the cameras themselves.
    Weak features count too if most of a sample of the images have less than half of the features that they may have.
    Raises InputError if an image cannot be read, or hardly any has features.
    """
    names, database = [p.name for p in photos], folder / DATABASE
    if not database.exists():
        database.with_name(DATABASE + ".partial").unlink(missing_ok=True)
        with whole(database) as partial:
            write_images(new_model(cameras[1], names, cameras[0]), partial)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = threads, LARGEST_SIDE
    most = max(p.width * p.height for p in photos) // PIXELS_A_FEATURE
    options.sift.max_num_features = min(max_features, max(most, LEAST_FEATURES))
    is_poor = most < LEAST_FEATURES
    if not is_poor:
        sample = database.with_name("sample.db")
        sample.unlink(missing_ok=True)
        places = sorted({round(i) for i in np.linspace(0, len(names) - 1, SAMPLE)})
        find_features(sample, images, [names[i] for i in places], options, masks)
        is_poor = float(np.median([n or 0 for n in count_features(sample)])) < 0.5 * options.sift.max_num_features
        sample.unlink()
    if is_poor:
        options.sift.peak_threshold = FAINT
    with progress("Finding features", len(names)) as advance:
        for start in range(0, len(names), BATCH):
            find_features(database, images, names[start : start + BATCH], options, masks)
            advance(len(names[start : start + BATCH]))
    counts = count_features(database)
    if None in counts:
        raise InputError(f"{names[counts.index(None)]} cannot be read by COLMAP: repair or remove it.")
    counted = [n or 0 for n in counts]
    if sum(n >= FEATURES for n in counted) < 2:
        raise InputError(
            f"Hardly any features: {max(counted)} in the best image. The images are blank, blurred or masked over."
        )


def matching_pairs(database: Path) -> list[tuple[int, int]]:
    """Pairs of image ids with enough matches that one motion of the camera explains."""
    with pycolmap.Database.open(database) as opened:
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
    return [pycolmap.pair_id_to_image_pair(p) for p, n in zip(pairs, inliers, strict=True) if n >= MIN_INLIERS]


def are_in_order(database: Path, names: Sequence[str]) -> bool:
    """Whether images come in the order of the motion: names are numbered, and most images share the most matches with
    the one before or after."""
    count = len(names)
    inliers = np.zeros((count, count), np.int64)
    with pycolmap.Database.open(database) as opened:
        for pair, matches in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            inliers[first - 1, second - 1] = inliers[second - 1, first - 1] = matches
    matched = np.flatnonzero(inliers.max(-1, initial=0) >= MIN_INLIERS)
    is_near = np.abs(inliers.argmax(-1) - np.arange(count))[matched] <= 1
    return are_numbered(names) and len(matched) > 0 and bool(is_near.mean() > IN_ORDER)


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

        descriptors = np.concatenate([sample(i, max(20, WORDS_FROM // count)) for i in range(count)])
        words = descriptors[rng.choice(len(descriptors), WORDS, replace=len(descriptors) < WORDS)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of few descriptors, words may be empty
            words, _ = kmeans2(descriptors, words, ROUNDS, minit="matrix")
        for i, vector in enumerate(vectors):
            descriptors = sample(i, SUMMED)
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


def choose_pairs(
    matching: Matching, names: Sequence[str], alike: NDArray[np.float32], overlap: int, from_video: bool
) -> tuple[Pairs, str]:
    """Pairs (i < j) to match, and how and why they were chosen in words."""
    count, why = len(names), "as asked"
    if matching == "auto":
        nearest_in_time = np.abs(alike.argmax(-1) - np.arange(count)) <= NEXT
        if count <= FEW:
            matching, why = "exhaustive", f"{count} images are few"
        elif from_video:
            matching, why = "sequential", "frames of a video"
        elif are_numbered(names) and nearest_in_time.mean() > IN_ORDER:
            matching, why = "sequential", "numbered frames that look like their neighbours"
        elif count <= MANY:
            matching, why = "exhaustive", f"{count} images in no order"
        else:
            matching, why = "retrieval", f"{count} images in no order are too many to match all"
    summary = f"{matching} ({why})"
    if matching == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)], summary
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    usable, number = apart > 0, LOOK_ALIKES
    if matching != "retrieval":  # pairs that may show a place again: as similar as images a few frames apart
        edge = alike[apart == min(overlap, count - 1)]
        usable = (apart > max(FAR_STEPS[-1], overlap)) & (alike >= np.percentile(edge, 25))
        number = REVISITS
    alike = np.where(usable, alike, -np.inf)
    order = np.argsort(-alike, axis=-1, kind="stable")[:, :number]
    some = {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(order) for j in row if alike[i, j] > -1e9}
    if matching == "retrieval":
        return sorted(some), summary
    steps = [*range(1, overlap + 1), *(s for s in FAR_STEPS if s > overlap)]
    near = {(i, i + s) for s in steps for i in range(count - s)}
    return sorted(near | some), f"{summary}, {len(some)} pairs that may be revisits"
