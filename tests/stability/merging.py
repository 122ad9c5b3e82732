"""Stability of lookups, merging, dropping, losses and the optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import oracle
import torch
from random_scenes import Array
from stability.cases import UNIT, Case, Outcome, Precision, compare, float32, single, tried

from mmpi_ns.ops.depth_sums import depth_sums
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.variation import clamped_differences
from mmpi_ns.sampler import merge, prune
from mmpi_ns.scene.texels import BRICK, make_grids
from mmpi_ns.training import losses
from mmpi_ns.training.touched_adam import TouchedAdam

# Lookups -------------------------------------------------------------------------------------------------------------


def _lookup(side: int, positions: Array, precision: Precision) -> Outcome:
    """Bilinear values on two planes and the gradient of the texels, whatever is read how often."""
    rng = np.random.default_rng(0)
    (grid,) = make_grids([(2, side, 3)])
    uv, planes = single(positions), np.arange(len(positions)) % 2
    values, by = single(rng.normal(size=(len(grid.rows), 2))), single(rng.normal(size=(len(uv), 2)))
    table = torch.zeros(len(grid.places) * BRICK, 2)
    table[grid.rows] = float32(values)
    rows, weights = grid.bilinear(torch.tensor(planes), float32(uv))
    (actual,), (gradient,) = tried(precision, lambda t: interpolate(t, rows, weights), table, by=(by,))
    images = values.reshape(2, side, 3, 2)
    wanted, slope, sizes = np.zeros((len(uv), 2)), np.zeros_like(images), np.zeros_like(images)
    reads = np.zeros(images.shape[:3])
    for i, (u, v) in enumerate(uv):
        for texel, weight in oracle.corners((u, v), (side, 3)):
            at = (planes[i], *texel)
            wanted[i] += weight * images[at]
            slope[at] += weight * by[i]
            # A position is known to a rounding; so is each weight, times the texels across.
            sizes[at] += np.abs(by[i]) * (weight + side / 4)
            reads[at] += 1
    found_slope = gradient[grid.rows.numpy()].reshape(images.shape)
    # Sums of n terms one after the other: up to n roundings of their magnitudes.
    roundings = 8 + float(reads.max())
    value = compare(actual, wanted, side * np.abs(images).max(), 4)
    return Outcome(value, compare(found_slope, slope, sizes, roundings))


def _spread(count: int) -> Array:
    return np.random.default_rng(1).uniform(-1, 1, (count, 2))


# Merging and dropping ------------------------------------------------------------------------------------------------


def _merge_order(keys: Array, precision: Precision, empty: bool = False) -> Outcome:
    """Nearest first; equal distances in the order (MPI, plane). Counts samples in a wrong place. Of the keys 1/t
    [R, H, S] each head has the first few; where ``empty``, some rays have none."""
    rays, heads, samples = keys.shape
    keys = single(-np.sort(-keys, axis=-1))
    counts = np.random.default_rng(2).integers(0, samples + 1, (rays, heads))
    counts[::5] = 0 if empty else counts[::5]
    per_ray = counts.sum(-1)
    # As the sampler lists them: head by head, and ray by ray within it.
    flat = [(k, r, i) for k in range(heads) for r in range(rays) for i in range(counts[r, k])]
    distances = float32([keys[r, k, i] for k, r, i in flat])
    with precision.context():
        index = merge(torch.tensor([r for _, r, _ in flat]), distances).split(per_ray.tolist())
    wrong = 0
    for ray in range(rays):
        wanted = [n for *_, n in sorted((-keys[r, k, i], k, i, n) for n, (k, r, i) in enumerate(flat) if r == ray)]
        actual = index[ray].tolist()
        wrong += sum(a != b for a, b in zip(actual, wanted, strict=False)) + abs(len(actual) - len(wanted))
    return Outcome.of([], wrong=wrong)


def _dropping(taus: Array, threshold: float, share: float, precision: Precision, keeps_all: bool = False) -> Outcome:
    """What is kept, and mass and depth of what is dropped. Within 16 roundings of the bound either is right."""
    taus = single(taus)
    rays, samples = taus.shape
    starts = torch.arange(rays + 1) * samples
    with precision.context():
        index, skipped_before, starts, skipped_total, dropped_mass = prune(
            float32(taus.ravel()), starts, threshold, share
        )
    errors, wrong, roundings = [], 0, 4 + math.log2(samples)
    for r in range(rays):
        made, bound, there = oracle.composite(taus[r]), min(threshold, share / samples), slice(*starts[r : r + 2])
        kept = np.zeros(samples, bool)
        kept[(index[there] - r * samples).tolist()] = True
        size = made.weights * (1 - np.log(np.maximum(made.in_front, 1e-300)))
        unclear = np.abs(made.weights - bound) <= 16 * UNIT * size
        wrong += int(((kept != (made.weights > bound)) & ~unclear).sum()) + (keeps_all and not kept.all())
        dropped = np.where(kept, 0, taus[r])
        before = (np.cumsum(dropped) - dropped)[kept]
        total, mass = dropped.sum(), made.weights[~kept].sum()
        errors += [
            compare(skipped_before[there], before, before + total * 2.0**-20, roundings),
            compare(skipped_total[r], [total], total, roundings),
            compare(dropped_mass[r], [mass], size.sum(), roundings),
        ]
    return Outcome.of(errors, wrong=wrong)


# Losses --------------------------------------------------------------------------------------------------------------

Wanted = tuple[float, Array, Array]
"""A loss, its gradient, and the gradient's magnitudes."""


def _loss(precision: Precision, function: Callable[[torch.Tensor], torch.Tensor], at: Array, wanted: Wanted,
          size: float, roundings: float) -> Outcome:  # fmt: skip
    """A loss of one variable; ``size`` is the value's."""
    (value,), (gradient,) = tried(precision, function, at)
    return Outcome(
        compare(value[None], [wanted[0]], size, roundings), compare(gradient, wanted[1], wanted[2], roundings)
    )


def _distortion(weights: Array, positions: Array, precision: Precision) -> Outcome:
    """Against the sum over all pairs: sum_j w_j |s_i - s_j|, before and behind, in extended precision."""
    inverse_t = single(1 / np.maximum(positions, 1e-30) - 1)
    w, s = single(weights).astype(np.longdouble), 1 / (1 + inverse_t.astype(np.longdouble))
    rays, count = s.shape
    before, moment = np.cumsum(w, -1) - w, np.cumsum(w * s, -1) - w * s
    behind = w.sum(-1, keepdims=True) - w - before
    moment_behind = (w * s).sum(-1, keepdims=True) - w * s - moment
    pairs = s * before - moment + moment_behind - s * behind
    value = float((w * pairs).sum() + (w**2).sum() / count / 3) / rays
    slope = 2 * pairs + 2 * w / count / 3
    size = 2 * (s * w.sum(-1, keepdims=True) + (w * s).sum(-1, keepdims=True)) + w / count
    starts, nothing = torch.arange(rays + 1) * count, torch.tensor([[0.0, 1.0]]).expand(rays, 2)
    others = float32(inverse_t.ravel()), starts, torch.full((rays,), 1 / count), nothing, 1.0

    def distortion(x: torch.Tensor) -> torch.Tensor:
        return depth_sums(x.flatten(), *others).spread.mean()

    wanted = value, (slope / rays).astype(np.float64), (size / rays).astype(np.float64)
    total = float(2 * (w.sum(-1) ** 2).mean()) + 1e-30
    return _loss(precision, distortion, weights, wanted, total, 4 + 2 * math.log2(count))


def _entropy(precision: Precision) -> Outcome:
    """Transmittances 0, 1e-30, ..., 1: finite value and gradient, 0 slope where the probability is clamped."""
    low, high = single([1e-6, 1 - 1e-6])
    t = single([[0.0], [1e-30], [1e-12], [1e-5], [0.3], [0.5], [0.9], [1 - 1e-5], [1.0]])
    p = np.clip(t, low, high)
    value = -(p * np.log(p) + (1 - p) * np.log(1 - p)).mean()
    slope = np.where((t >= low) & (t <= high), np.log((1 - p) / p), 0) / len(t)
    wanted = float(value), slope, (1 / p + 1 / (1 - p)) / len(t)
    return _loss(precision, losses.background_entropy, t, wanted, 1.0, 16)


def _keypoint(precision: Precision) -> Outcome:
    """Rays with no mass near the point, with all of it there, at 1/t of 1e-6 and 1e6, and without a point."""
    depths = single([[0.5], [0.5], [1e-6], [1e6], [0.0], [0.25]])
    q = single(np.tile(np.linspace(1.2, 0.8, 9), (6, 1)) * np.where(depths > 0, depths, 1.0))
    w = single(np.full((6, 9), 0.1))
    w[:2] = 0
    w[1, 4] = 1
    q[5] = 3.0  # nothing within reach of the point
    x = (q - depths) / (0.06 * np.maximum(depths, 1e-12))
    window = np.exp(-0.5 * x**2)
    reach = (np.abs(x) < 3).any(-1) & (depths[:, 0] > 0)
    mass = (w * window).sum(-1) + 1e-4
    slope = np.where(reach[:, None], -window / mass[:, None], 0) / reach.sum()
    # x is a difference of 1/t, 17 widths long: its rounding counts x^2 17 times.
    wanted = float(-np.log(mass)[reach].mean()), slope, np.abs(slope) * (1 + 20 * np.abs(x)) + 1e-30
    targets = float32(np.concatenate([depths, 0.06 * np.maximum(depths, 1e-12)], -1))
    there = float32(q.ravel()), torch.arange(7) * 9, torch.zeros(6), targets, 1.0

    def keypoint(v: torch.Tensor) -> torch.Tensor:
        _, mass, reached = depth_sums(v.flatten(), *there)
        return losses.depth_priors(mass, reached, losses.KEYPOINT_OUTLIERS, reached.sum().clamp(min=1))

    return _loss(precision, keypoint, w, wanted, 60.0, 16)


def _variation(precision: Precision) -> Outcome:
    """Differences of neighbours from 1e-30 to 1e4: a slope of at most 1 each."""
    values = single([[0.0], [1e-30], [1e-6], [0.5], [1.0], [1e4], [-1e4]])
    around, scales = np.zeros((7, 6, 1)), np.tile([[1.0], [0.5], [2.0], [0.0], [1.0], [0.25]], (7, 1, 1))
    d = values[:, None, :] - around
    huber = np.where(np.abs(d) <= 1, 0.5 * d**2, np.abs(d) - 0.5)
    slope = (scales * np.clip(d, -1, 1)).sum(1) / 6
    wanted, tensors = (float((scales * huber).sum() / 6), slope, np.abs(slope) + 1e-35), (around, scales[..., 0])
    given = [float32(x) for x in tensors]
    return _loss(precision, lambda v: clamped_differences(v, *given), values, wanted, 2e4, 16)


def _adam(precision: Precision) -> Outcome:
    """Steps of Adam for gradients of 1e-30 to 1e18: at most 8 lr in two steps, untouched entries not at all."""
    sizes = np.array([0.0, 1e-30, 1e-12, 1e-4, 1.0, 1e6, 1e18])
    start = np.linspace(-1, 1, 7)
    param = torch.nn.Parameter(float32(start))
    optimizer = TouchedAdam([param], lr=0.1)
    mean, square, value = np.zeros(7), np.zeros(7), single(start)
    for step, sign in enumerate((1.0, -0.5), 1):
        gradient = single(sizes * sign)
        param.grad = float32(gradient)
        with precision.context():
            optimizer.step()
        touched = gradient != 0
        mean = np.where(touched, 0.9 * mean + 0.1 * gradient, mean)
        square = np.where(touched, 0.99 * square + 0.01 * gradient**2, square)
        root = np.sqrt(square / (1 - 0.99**step)) + 1e-8
        value = value - np.where(touched, 0.1 * mean / (1 - 0.9**step) / root, 0)
    return Outcome(compare(param, value, 1.0, 16))


def cases() -> list[Case]:
    """All cases of lookups, merging, losses and the optimiser."""
    rng, ever = np.random.default_rng(3), math.inf
    border = np.array([[a, b] for a in (-1, 1, -1 - 1e-7, 1 + 1e-7, 0) for b in (-1, 1, 5.0, -5.0)])
    ties, infinite = rng.integers(0, 4, (40, 12, 9)) / 4, np.zeros((20, 12, 3))
    loose, close = rng.random((40, 12, 9)), 1 + rng.integers(0, 3, (40, 4, 9)) * 2.0**-23
    thin, mixed = rng.exponential(1e-2, (8, 1000)), 10 ** rng.uniform(-30, 4, (8, 300))
    weights, places = rng.exponential(1e-4, (2, 10_000)), np.sort(rng.random((2, 10_000)), -1)
    heavy, one_place = rng.exponential(3e-3, (2, 300)), np.array([[0.7] * 300, [1.0] * 300])
    start = np.tile(-np.log1p(-1 / np.arange(256, 0, -1).clip(1.001)), (4, 1))
    looked_up = "values to a rounding of the position times the texels across, gradients likewise"
    ordered = "nearest first, ties by (MPI, plane): no sample in a wrong place"
    kept = "the samples above the bound, the mass and depth of the others to 4 + log2(samples) roundings"
    summed = "the sum over all pairs, to 4 + 2 log2(samples) roundings"
    rows: list[tuple[str, str, str, Callable[[Precision], Outcome]]] = [
        ("lookups", "200 positions on planes of 4,096 texels", looked_up, partial(_lookup, 4096, _spread(200))),
        ("lookups", "planes of 2 texels", looked_up, partial(_lookup, 2, _spread(200))),
        ("lookups", "positions on the border and beyond it", looked_up, partial(_lookup, 9, border)),
        ("lookups", "10,000 lookups in one cell", looked_up, partial(_lookup, 3, 0.2 + 0.01 * _spread(10_000))),
        ("merging", "12 MPIs, distances that nearly all tie", ordered, partial(_merge_order, ties)),
        ("merging", "12 MPIs, all samples at infinity", ordered, partial(_merge_order, infinite)),
        ("merging", "12 MPIs, random distances, some rays empty", ordered, partial(_merge_order, loose, empty=True)),
        ("merging", "distances a rounding apart", ordered, partial(_merge_order, close)),
        ("dropping", "256 planes at equal weight, a tenth of it as the bound", "nothing dropped",
         partial(_dropping, start, 3e-3, 0.1, keeps_all=True)),
        ("dropping", "1,000 samples of mean depth 1e-2, threshold 3e-3", kept, partial(_dropping, thin, 3e-3, ever)),
        ("dropping", "depths 1e-30 to 1e4, threshold 1e-3", kept, partial(_dropping, mixed, 1e-3, ever)),
        ("losses", "distortion of 10,000 samples", summed, partial(_distortion, weights, places)),
        ("losses", "distortion of 300 samples at one distance, and at infinity", "the same",
         partial(_distortion, heavy, one_place)),
        ("losses", "background entropy at transmittance 0, 1e-30, ..., 1", "finite, to 16 roundings", _entropy),
        ("losses", "keypoint depth: no mass, all mass, 1/t 1e-6 and 1e6, no point", "to 16 roundings", _keypoint),
        ("losses", "total variation with differences up to 1e4", "slopes of at most 1 each", _variation),
        ("optimiser", "gradients 0, 1e-30, ..., 1e18, with changing sign", "Adam's step to 16 roundings", _adam),
    ]  # fmt: skip
    return [Case(*row) for row in rows]
