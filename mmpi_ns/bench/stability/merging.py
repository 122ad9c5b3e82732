"""Stability of lookups, merging, dropping, losses and the optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from mmpi_ns.bench.stability import exact
from mmpi_ns.bench.stability.cases import UNIT, Case, Error, Outcome, Precision, compare, count_wrong, single
from mmpi_ns.bench.stability.exact import Array
from mmpi_ns.ops.interpolate import interpolate
from mmpi_ns.ops.march.reference import merge, prune
from mmpi_ns.ops.variation.reference import clamped_differences
from mmpi_ns.scene.texels import BRICK, make_grids
from mmpi_ns.training import losses
from mmpi_ns.training.touched_adam import TouchedAdam

# Lookups -------------------------------------------------------------------------------------------------------------

LOOKUP = "values to a rounding of the position times the texels across, gradients likewise"


def _lookup(side: int, positions: Array, precision: Precision) -> Outcome:
    """Bilinear values on two planes and the gradient of the texels, whatever is read how often."""
    rng = np.random.default_rng(0)
    (grid,) = make_grids([(2, side, 3)])
    uv = single(positions)
    planes = np.arange(len(uv)) % 2
    values, by = single(rng.normal(size=(grid.texels, 2))), single(rng.normal(size=(len(uv), 2)))
    table = torch.zeros(len(grid.places) * BRICK, 2)
    table[grid.rows] = torch.tensor(values, dtype=torch.float32)
    table.requires_grad_()
    rows, weights = grid.bilinear(torch.tensor(planes), torch.tensor(uv, dtype=torch.float32))
    with precision.context():
        found = interpolate(table, rows, weights)
        (found * torch.tensor(by, dtype=torch.float32)).sum().backward()
    assert table.grad is not None
    images = values.reshape(2, side, 3, 2)
    wanted, slope = np.zeros((len(uv), 2)), np.zeros_like(images)
    sizes, reads = np.zeros_like(images), np.zeros(images.shape[:3])
    for i, (u, v) in enumerate(uv):
        x, y = (min(max((c + 1) / 2 * (n - 1), 0.0), n - 1.0) for c, n in ((u, 3), (v, side)))
        i0, j0 = min(int(x), 1), min(int(y), side - 2)
        for dy, dx in np.ndindex(2, 2):
            weight = (dx * (x - i0) + (1 - dx) * (1 - x + i0)) * (dy * (y - j0) + (1 - dy) * (1 - y + j0))
            at = (planes[i], j0 + dy, i0 + dx)
            wanted[i] += weight * images[at]
            slope[at] += weight * by[i]
            sizes[at] += np.abs(by[i]) * (weight + side * 1e-30)
            # A position is known to a rounding; so is each weight, times the texels across.
            sizes[at] += np.abs(by[i]) * side / 4
            reads[at] += 1
    found_slope = table.grad.to_dense()[grid.rows].reshape(images.shape)
    # Sums of n terms one after the other: up to n roundings of their magnitudes.
    roundings = 8 + float(reads.max())
    return Outcome(
        compare(found, wanted, side * np.abs(images).max(), 4), compare(found_slope, slope, sizes, roundings)
    )


def _spread(count: int) -> Array:
    return np.random.default_rng(1).uniform(-1, 1, (count, 2))


# Merging and dropping ------------------------------------------------------------------------------------------------


def _merged(keys: Array, counts: Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Keys [R, H, S] of heads whose first ``counts`` [R, H] samples exist."""
    rays, heads, _ = keys.shape
    per_ray = counts.sum(-1)
    width = max(1, int(per_ray.max()))
    slots, flat = [], []
    for k in range(heads):
        for r in range(rays):
            start = counts[r, :k].sum()
            slots += [r * width + start + i for i in range(counts[r, k])]
            flat += list(keys[r, k, : counts[r, k]])
    return merge(torch.tensor(slots), torch.tensor(np.array(flat), dtype=torch.float32), torch.tensor(per_ray), False)


def _merge_order(keys: Array, precision: Precision, empty: bool = False) -> Outcome:
    """Nearest first; equal distances in the order (MPI, plane). Counts samples in a wrong place."""
    rng = np.random.default_rng(2)
    rays, heads, samples = keys.shape
    keys = single(-np.sort(-keys, axis=-1))
    counts = rng.integers(0, samples + 1, (rays, heads))
    counts[::5] = 0 if empty else counts[::5]
    with precision.context():
        index, valid = _merged(keys, counts)
    wrong, flat_of = 0, np.full((rays, heads, samples), -1)
    number = 0
    for k in range(heads):
        for r in range(rays):
            flat_of[r, k, : counts[r, k]] = number + np.arange(counts[r, k])
            number += counts[r, k]
    for r in range(rays):
        wanted = sorted((-keys[r, k, i], k, i) for k in range(heads) for i in range(counts[r, k]))
        order = [int(flat_of[r, k, i]) for _, k, i in wanted]
        found = index[r][valid[r]].tolist()
        wrong += sum(a != b for a, b in zip(found, order, strict=False)) + abs(len(found) - len(order))
    return Outcome(count_wrong(wrong))


def _dropping(taus: Array, threshold: float, share: float, precision: Precision, keeps_all: bool = False) -> Outcome:
    """What is kept, and mass and depth of what is dropped. Within 16 roundings of the bound either is right."""
    taus = single(taus)
    rays, samples = taus.shape
    merged = (torch.arange(rays * samples).view(rays, samples), torch.ones(rays, samples, dtype=torch.bool))
    with precision.context():
        found = prune(*merged, torch.tensor(taus.ravel(), dtype=torch.float32), threshold, share)
    errors, wrong = [], 0
    for r in range(rays):
        made = exact.composite(taus[r])
        bound = min(threshold, share / samples)
        kept = np.zeros(samples, bool)
        kept[(found.order[r][found.valid[r]] - r * samples).tolist()] = True
        size = made.weights * (1 - np.log(np.maximum(made.in_front, 1e-300)))
        unclear = np.abs(made.weights - bound) <= 16 * UNIT * size
        wrong += int(((kept != (made.weights > bound)) & ~unclear).sum()) + (keeps_all and not kept.all())
        dropped = np.where(kept, 0, taus[r])
        before = (np.cumsum(dropped) - dropped)[kept]
        total, mass = dropped.sum(), made.weights[~kept].sum()
        roundings = 4 + math.log2(samples)
        errors += [
            compare(found.skipped_before[r][found.valid[r]], before, before + total * 2.0**-20, roundings),
            compare(found.skipped_total[r], np.array([total]), total, roundings),
            compare(found.dropped_mass[r], np.array([mass]), size.sum(), roundings),
        ]
    return Outcome(Error.worst(errors) if not wrong else count_wrong(wrong))


# Losses --------------------------------------------------------------------------------------------------------------


def _loss(function: Callable, variable: Array, wanted: Callable[[Array], tuple[float, Array, Array]], size: float,
          roundings: float, precision: Precision) -> Outcome:  # fmt: skip
    """A loss of one variable; ``wanted`` gives value, gradient and the gradient's magnitudes."""
    variable = single(variable)
    given = torch.tensor(variable, dtype=torch.float32, requires_grad=True)
    with precision.context():
        value = function(given)
        value.backward()
    assert given.grad is not None
    expected, slope, magnitude = wanted(variable)
    return Outcome(
        compare(value[None], np.array([expected]), size, roundings), compare(given.grad, slope, magnitude, roundings)
    )


def _distortion(weights: Array, positions: Array, precision: Precision) -> Outcome:
    """Against the sum over all pairs."""
    s = single(positions)
    count = s.shape[1]
    interval = 1 / count

    def wanted(w: Array):
        value, slope, size = 0.0, np.zeros_like(w), np.zeros_like(w)
        for r in range(len(w)):
            # sum_j w_j |s_i - s_j|, pairs before and behind, in extended precision.
            long, place = w[r].astype(np.longdouble), s[r].astype(np.longdouble)
            before, moment = np.cumsum(long) - long, np.cumsum(long * place) - long * place
            pairs = place * before - moment + (moment[-1] + long[-1] * place[-1] - moment - long * place)
            pairs -= place * (before[-1] + long[-1] - before - long)
            value += float((long * pairs).sum() + (long**2).sum() * interval / 3)
            slope[r] = (2 * pairs + 2 * long * interval / 3).astype(np.float64)
            size[r] = 2 * (s[r] * w[r].sum() + (w[r] * s[r]).sum()) + w[r] * interval
        return value / len(w), slope / len(w), size / len(w)

    tensors = [torch.tensor(x, dtype=torch.float32) for x in (s, np.full_like(s, interval))]
    total = single(weights).sum(-1)
    return _loss(lambda w: losses.distortion(w, *tensors), weights, wanted, float(2 * (total**2).mean()) + 1e-30,
                 4 + 2 * math.log2(count), precision)  # fmt: skip


def _entropy(precision: Precision) -> Outcome:
    """Transmittances 0, 1e-30, ..., 1: finite value and gradient, 0 slope where the probability is clamped."""
    low = float(np.float32(1e-6))
    high = float(np.float32(1 - 1e-6))

    def wanted(t: Array):
        p = np.clip(t, low, high)
        value = -(p * np.log(p) + (1 - p) * np.log(1 - p)).mean()
        slope = np.where((t >= low) & (t <= high), np.log((1 - p) / p), 0) / len(t)
        return float(value), slope, (1 / p + 1 / (1 - p)) / len(t)

    t = np.array([[0.0], [1e-30], [1e-12], [1e-5], [0.3], [0.5], [0.9], [1 - 1e-5], [1.0]])
    return _loss(losses.background_entropy, t, wanted, 1.0, 16, precision)


def _keypoint(precision: Precision) -> Outcome:
    """Rays with no mass near the point, with all of it there, at 1/t of 1e-6 and 1e6, and without a point."""
    known = single(np.array([[0.5], [0.5], [1e-6], [1e6], [0.0], [0.25]]))
    q = single(np.tile(np.linspace(1.2, 0.8, 9), (6, 1)) * np.where(known > 0, known, 1.0))
    weights = np.full((6, 9), 0.1)
    weights[0], weights[1] = 0, 0
    weights[1, 4] = 1
    q[5] = 3.0  # nothing within reach of the point

    def wanted(w: Array):
        x = (q - known) / (0.06 * np.maximum(known, 1e-12))
        window = np.exp(-0.5 * x**2)
        reach = (np.abs(x) < 3).any(-1) & (known[:, 0] > 0)
        mass = (w * window).sum(-1) + 1e-4
        slope = np.where(reach[:, None], -window / mass[:, None], 0) / reach.sum()
        # x is a difference of 1/t, 17 widths long: its rounding counts x^2 17 times.
        return float(-np.log(mass)[reach].mean()), slope, np.abs(slope) * (1 + 20 * np.abs(x)) + 1e-30

    places, depth = (torch.tensor(x, dtype=torch.float32) for x in (q, known))
    valid = torch.ones(6, 9, dtype=torch.bool)
    return _loss(lambda w: losses.keypoint_depth(w, places, depth, valid), weights, wanted, 60.0, 16, precision)


def _variation(precision: Precision) -> Outcome:
    """Differences of neighbours from 1e-30 to 1e4: a slope of at most 1 each."""
    values = np.array([[0.0], [1e-30], [1e-6], [0.5], [1.0], [1e4], [-1e4]])
    around = single(np.zeros((7, 6, 1)))
    scales = single(np.tile([1.0, 0.5, 2.0, 0.0, 1.0, 0.25], (7, 1)))

    def wanted(v: Array):
        d = v[:, None, :] - around
        huber = np.where(np.abs(d) <= 1, 0.5 * d**2, np.abs(d) - 0.5)
        slope = (scales[..., None] * np.clip(d, -1, 1)).sum(1) / 6
        return float((scales[..., None] * huber).sum() / 6), slope, np.abs(slope) + 1e-35

    tensors = [torch.tensor(x, dtype=torch.float32) for x in (around, scales)]
    return _loss(lambda v: clamped_differences(v, *tensors), values, wanted, 2e4, 16, precision)


def _adam(precision: Precision) -> Outcome:
    """Steps of Adam for gradients of 1e-30 to 1e18: at most 8 lr in two steps, untouched entries not at all."""
    sizes = np.array([0.0, 1e-30, 1e-12, 1e-4, 1.0, 1e6, 1e18])
    start = np.linspace(-1, 1, 7)
    param = torch.nn.Parameter(torch.tensor(start, dtype=torch.float32))
    optimizer = TouchedAdam([param], lr=0.1)
    mean, square, value = np.zeros(7), np.zeros(7), single(start)
    for step, sign in enumerate((1.0, -0.5), 1):
        param.grad = torch.tensor(sizes * sign, dtype=torch.float32)
        with precision.context():
            optimizer.step()
        gradient = single(sizes * sign)
        touched = gradient != 0
        mean = np.where(touched, 0.9 * mean + 0.1 * gradient, mean)
        square = np.where(touched, 0.99 * square + 0.01 * gradient**2, square)
        root = np.sqrt(square / (1 - 0.99**step)) + 1e-8
        value = value - np.where(touched, 0.1 * mean / (1 - 0.9**step) / root, 0)
    return Outcome(compare(param, value, 1.0, 16))


def cases() -> list[Case]:
    """All cases of lookups, merging, losses and the optimiser."""
    rng = np.random.default_rng(3)
    border = np.array([[a, b] for a in (-1, 1, -1 - 1e-7, 1 + 1e-7, 0) for b in (-1, 1, 5.0, -5.0)])
    ties, infinite = rng.integers(0, 4, (40, 12, 9)) / 4, np.zeros((20, 12, 3))
    loose, close = rng.random((40, 12, 9)), 1 + rng.integers(0, 3, (40, 4, 9)) * 2.0**-23
    thin, mixed = rng.exponential(1e-2, (8, 1000)), 10 ** rng.uniform(-30, 4, (8, 300))
    weights, places = rng.exponential(1e-4, (2, 10_000)), np.sort(rng.random((2, 10_000)), -1)
    heavy, one_place = rng.exponential(3e-3, (2, 300)), np.array([[0.7] * 300, [1.0] * 300])
    ordered = "nearest first, ties by (MPI, plane): no sample in a wrong place"
    kept = "the samples above the bound, the mass and depth of the others to 4 + log2(samples) roundings"
    start = np.tile(-np.log1p(-1 / np.arange(256, 0, -1).clip(1.001)), (4, 1))
    rows: list[tuple[str, str, str, Callable[[Precision], Outcome]]] = [
        ("lookups", "200 positions on planes of 4,096 texels", LOOKUP, lambda p: _lookup(4096, _spread(200), p)),
        ("lookups", "planes of 2 texels", LOOKUP, lambda p: _lookup(2, _spread(200), p)),
        ("lookups", "positions on the border and beyond it", LOOKUP, lambda p: _lookup(9, border, p)),
        ("lookups", "10,000 lookups in one cell", LOOKUP, lambda p: _lookup(3, 0.2 + 0.01 * _spread(10_000), p)),
        ("merging", "12 MPIs, distances that nearly all tie", ordered, lambda p: _merge_order(ties, p)),
        ("merging", "12 MPIs, all samples at infinity", ordered, lambda p: _merge_order(infinite, p)),
        ("merging", "12 MPIs, random distances, some rays empty", ordered,
         lambda p: _merge_order(loose, p, empty=True)),
        ("merging", "distances a rounding apart", ordered,
         lambda p: _merge_order(close, p)),
        ("dropping", "256 planes at equal weight, a tenth of it as the bound", "nothing dropped",
         lambda p: _dropping(start, 3e-3, 0.1, p, keeps_all=True)),
        ("dropping", "1,000 samples of mean depth 1e-2, threshold 3e-3", kept,
         lambda p: _dropping(thin, 3e-3, math.inf, p)),
        ("dropping", "depths 1e-30 to 1e4, threshold 1e-3", kept,
         lambda p: _dropping(mixed, 1e-3, math.inf, p)),
        ("losses", "distortion of 10,000 samples", "the sum over all pairs, to 4 + 2 log2(samples) roundings",
         lambda p: _distortion(weights, places, p)),
        ("losses", "distortion of 300 samples at one distance, and at infinity", "the same",
         lambda p: _distortion(heavy, one_place, p)),
        ("losses", "background entropy at transmittance 0, 1e-30, ..., 1", "finite, to 16 roundings", _entropy),
        ("losses", "keypoint depth: no mass, all mass, 1/t 1e-6 and 1e6, no point", "to 16 roundings", _keypoint),
        ("losses", "total variation with differences up to 1e4", "slopes of at most 1 each", _variation),
        ("optimiser", "gradients 0, 1e-30, ..., 1e18, with changing sign", "Adam's step to 16 roundings", _adam),
    ]  # fmt: skip
    return [Case(*row) for row in rows]
