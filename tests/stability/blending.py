"""Stability of densities, shares and compositing: values and gradients against decimals and float64."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import oracle
import torch
from hand_made import starts_of
from random_scenes import Array
from scipy.special import expit
from stability.cases import (
    Case,
    Outcome,
    Precision,
    compare,
    float32,
    random_mpi,
    single,
    tried,
)

from mmpi_ns.blending import blend_shares, blended_optical_depth
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.composite import composite_weights, median_inverse_distance, render_colors
from mmpi_ns.scene.plan import ScenePlan

TAUS = (0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 5.0, 30.0, 90.0, 1e4)
LONG = 10_000
"""Samples of a long ray."""

# Densities -----------------------------------------------------------------------------------------------------------


def _layout(planes: int) -> Any:
    """Of a field of one MPI."""
    mpi = random_mpi(np.random.default_rng(0), planes)
    return MMPIField(ScenePlan((mpi,), None, 0.05, 1.0), feature_channels=3, hidden_width=4).layout


def _density(raw: Array, planes: int, precision: Precision) -> Outcome:
    """tau = softplus(raw + b_l) 256 / L on every plane, for every raw density."""
    values, index = np.tile(single(raw), planes), np.repeat(np.arange(planes), len(raw))
    layout, at = _layout(planes), torch.tensor(index)
    (tau,), (gradient,) = tried(precision, lambda x: layout.optical_depth(0, x, at), values)
    bias, interval = oracle.plane_bias(planes)
    x = values + bias[index]
    wanted, slope = np.logaddexp(0, x) * interval, expit(x) * interval
    size = np.abs(values) + np.abs(bias[index]) + 1
    # d sigmoid = sigmoid (1 - sigmoid) dx <= sigmoid dx.
    return Outcome(compare(tau, wanted, wanted + slope * size, 16), compare(gradient, slope, slope * size, 16))


def _equal_start(planes: int, precision: Precision) -> Outcome:
    """A new MPI gives every plane the weight 1/L (the last one 0.999 of what is left)."""
    layout = _layout(planes)
    with precision.context():
        tau = layout.optical_depth(0, torch.zeros(planes), torch.arange(planes))
        made = composite_weights(tau, torch.tensor([0, planes]), torch.zeros_like(tau), torch.zeros(1, 1))
    wanted = np.full(planes, 1 / planes)
    wanted[-1] *= 0.999
    # log(e^b - 1) is rounded once, at magnitudes up to |b|; the depths in front add up to log L.
    size = wanted * (1 + np.abs(oracle.plane_bias(planes)[0]).max() + math.log(planes))
    return Outcome(compare(made.weights, wanted, size, 16))


# Shares and blended depths -------------------------------------------------------------------------------------------


def _blending(heads: int, scale: float, precision: Precision, level: float = 0.0, half: bool = False) -> Outcome:
    """Votes of a level and scale, for samples of every optical depth; ``half``: held in bfloat16."""
    rng, count = np.random.default_rng(heads), 40 * len(TAUS)
    own, cover = rng.integers(0, heads, count), rng.random((count, heads)) < 0.7
    cover[np.arange(count), own] = True
    given = float32(level + rng.normal(size=(count, heads)) * scale).to(torch.bfloat16 if half else torch.float32)
    reliability, tau = given.double().numpy(), single(np.resize(np.array(TAUS), count))

    def blended(votes: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        return blended_optical_depth(depth, *blend_shares(votes, torch.tensor(cover), torch.tensor(own)))

    (actual,), (found_by_vote, found_by_tau) = tried(precision, blended, given, tau)
    wanted = [oracle.blend(t, r, c, int(o)) for t, r, c, o in zip(tau, reliability, cover, own, strict=True)]
    value, by_tau, by_vote = (np.array([getattr(w, n) for w in wanted]) for n in ("depth", "by_tau", "by_reliability"))
    highest = np.where(cover, reliability, -np.inf).max(-1)
    spread = 1 + highest - np.where(cover, reliability, np.inf).min(-1)
    share = np.exp([oracle.log_shares(*row)[0] for row in zip(reliability, cover, own, strict=True)])
    # A log share is a difference of reliabilities, so it is known to a rounding of their spread; it scales tau' of a
    # thin sample, and moves -log(1 - alpha') of an opaque one by at most as much.
    size = value + np.minimum(value, 1) * spread + by_tau * tau
    size_votes = np.abs(by_vote).max(-1, keepdims=True) * (spread + tau * (tau < 88))[:, None]
    rounded = 2.0**-9 / 2.0**-24 / 8 if half else 1.0  # the gradient of a bfloat16 number is stored in bfloat16
    gradients = [
        compare(found_by_tau, by_tau, by_tau * (spread + tau) + share, 16),
        compare(found_by_vote, by_vote, size_votes, 16 * rounded),
    ]
    return Outcome.of([compare(actual, value, size, 16)], gradients)


def _ties(heads: int, precision: Precision) -> Outcome:
    """Equal reliabilities of any size share equally: P = 1/K."""
    levels = np.array([-1e3, -40.0, 0.0, 17.0, 1e3])
    reliability, own = float32(np.repeat(levels[:, None], heads, 1)), torch.arange(len(levels)) % heads
    with precision.context():
        actual = blend_shares(reliability, torch.ones_like(reliability, dtype=torch.bool), own)
    wanted = (-math.log(heads), math.log1p(-1 / heads))
    return Outcome.of([compare(x, np.full(len(levels), w), 1.0, 4) for x, w in zip(actual, wanted, strict=True)])


def _sole(precision: Precision) -> Outcome:
    """A sole cover keeps exactly tau whatever the others hold, NaN and infinity included; its votes get no gradient."""
    junk = [1e30, -math.inf, math.inf, math.nan, 0.0, -1e3]
    cover, own = torch.tensor([[True, False]] * len(junk)), torch.zeros(len(junk), dtype=torch.long)
    (actual,), (by_tau, by_vote) = tried(
        precision,
        lambda tau, votes: blended_optical_depth(tau, *blend_shares(votes, cover, own)),
        taus := [0.0, 1e-30, 1e-7, 3.0, 88.0, 1e4],
        [[5.0, j] for j in junk],
    )
    slopes = [compare(by_tau, np.ones(len(junk)), 1.0, 0), compare(by_vote, np.zeros((len(junk), 2)), 1.0, 0)]
    return Outcome.of([compare(actual, single(taus), 1.0, 0)], slopes)


# Compositing ---------------------------------------------------------------------------------------------------------


def _composite(taus: Array, precision: Precision, dropped: bool = False) -> Outcome:
    """Every ray [R, S]: weights, what passes, what is gathered, and the gradient of a random mixture of them."""
    rng = np.random.default_rng(5)
    taus = single(taus)
    roundings = 4 + math.log2(taus.shape[1])
    kept = rng.random(taus.shape) < 0.5 if dropped else np.ones(taus.shape, bool)
    skipped, there = np.where(kept, 0, taus), torch.tensor(kept)
    before, total = float32(np.cumsum(skipped, -1) - skipped), float32(skipped.sum(-1, keepdims=True))
    by_weight, by_rest = single(rng.normal(size=taus.shape)), single(rng.normal(size=(len(taus), 1)))

    def composited(tau: torch.Tensor) -> tuple[torch.Tensor, ...]:
        made = composite_weights(tau[there], starts_of(there), before[there], total)
        weights = torch.zeros(kept.shape).masked_scatter(there, made.weights)
        return weights, made.transmittance, made.accumulation

    (weights, transmittance, accumulation), (gradient,) = tried(precision, composited, taus, by=(by_weight, by_rest))
    errors, gradients = [], []
    for r, tau in enumerate(taus):
        wanted = oracle.composite(tau)
        front = 1 - np.log(np.maximum(wanted.in_front, 1e-300))
        rest = wanted.transmittance
        errors += [
            compare(weights[r], np.where(kept[r], wanted.weights, 0), wanted.weights * front, roundings),
            compare(transmittance[r], [rest], rest * (1 + tau.sum()), roundings),
            compare(accumulation[r], [wanted.accumulation], wanted.accumulation, roundings),
        ]
        g = np.where(kept[r], by_weight[r], 0)
        slope = np.where(kept[r], oracle.composite_gradient(tau, g, float(by_rest[r, 0])), 0)
        behind = np.abs(g * wanted.weights) * front
        size = np.abs(g) * wanted.in_front * front + np.cumsum(behind[::-1])[::-1] - behind
        size = size + np.abs(by_rest[r]) * rest * (1 + tau.sum())
        gradients.append(compare(gradient[r], slope, np.maximum(size, 1e-30), 2 * roundings))
    return Outcome.of(errors, gradients)


def _behind(precision: Precision) -> Outcome:
    """What lies behind the last ray, NaN and infinity included, changes nothing and gets no gradient."""
    (weights,), (gradient,) = tried(
        precision,
        lambda tau: composite_weights(tau, torch.tensor([0, 2]), torch.zeros(5), torch.zeros(1, 1)).weights,
        [0.3, 0.5, math.nan, math.inf, 1e30],
    )
    taus, wanted, slope = single([0.3, 0.5]), np.zeros(5), np.zeros(5)
    wanted[:2] = oracle.composite(taus).weights
    slope[:2] = oracle.composite_gradient(taus, np.ones(2), 0.0)
    return Outcome(compare(weights, wanted, 1.0, 4), compare(gradient, slope, 1.0, 8))


def _nothing(precision: Precision) -> Outcome:
    """A ray that meets nothing: black, transparent, infinitely far."""
    tau, starts = torch.full((4,), 5.0), torch.zeros(4, dtype=torch.int64)
    with precision.context():
        made = composite_weights(tau, starts, torch.zeros_like(tau), torch.zeros(3, 1))
        rgb = render_colors(made, torch.rand(4, 3), starts)
        median = median_inverse_distance(made.weights, torch.ones(4), starts)
    actual = torch.cat([rgb, made.accumulation, made.transmittance, median], -1)
    return Outcome(compare(actual, np.tile([0, 0, 0, 0, 1, 0], (3, 1)), 1.0, 0))


def _median(precision: Precision) -> Outcome:
    """1/t at half of what is gathered, in 10,000 samples; wrong is a sample whose gathered share is not half."""
    rng = np.random.default_rng(6)
    weights = single(rng.exponential(1e-4, (8, LONG)))
    inverse_t = single(-np.sort(-rng.random((8, LONG)), axis=-1))
    with precision.context():
        starts = torch.arange(9) * LONG
        actual = median_inverse_distance(float32(weights.ravel()), float32(inverse_t.ravel()), starts)
    at = (np.arange(8), np.abs(inverse_t - actual.double().numpy()).argmin(-1))
    gathered = np.cumsum(weights, -1)
    share, step = gathered[at] / gathered[:, -1], weights[at] / gathered[:, -1]
    return Outcome(compare(np.maximum(np.abs(share - 0.5) - step, 0), np.zeros(8), 1.0, 4 + math.log2(LONG)))


def _long(mean: float, opaque_at: int | None = None) -> Array:
    taus = np.random.default_rng(1).exponential(mean, (4, LONG))
    if opaque_at is not None:
        taus[:, opaque_at] = 1e4
    return taus


def _mixed(low: float, high: float) -> Array:
    return 10 ** np.random.default_rng(4).uniform(low, high, (40, 300))


def _before_last(transmittance: float) -> Array:
    taus = np.full((4, 64), -math.log(transmittance) / 63)
    taus[:, -1] = [0.0, 1e-3, 1.0, 1e4]
    return taus


def cases() -> list[Case]:
    """All cases of densities, shares and compositing."""
    spread = np.random.default_rng(7).uniform(-20, 20, 200)
    switch = np.outer([-1, 1], [1e4, 200, 88.7, 20.001]).ravel()
    tau = "tau and d tau to 16 roundings of the numbers added"
    shares = "tau', d tau' / d tau, d tau' / d R to 16 roundings of the differences of reliabilities"
    composited = "weights, transmittance, accumulation and their gradient to 4 + log2(samples) roundings of the depth "
    composited += "in front"
    around = np.linspace(-15, 15, 31)
    density = [
        ("raw densities -20 to 20, 64 planes", tau, partial(_density, spread, 64)),
        ("raw densities +-1e4, +-200, +-88.7, +-20.001 (softplus' switch)", tau, partial(_density, switch, 64)),
        ("1,024 planes, raw densities around each plane's bias", tau, partial(_density, around, 1024)),
        ("2 planes, released texels (-20)", tau, partial(_density, np.array([-20.0, 0.0]), 2)),
    ]
    for n in (16, 256, 1024):
        density.append((f"a new MPI of {n} planes", "weight 1/L on every plane", partial(_equal_start, n)))
    blending = []
    for heads, scale in ((2, 1.0), (2, 1e3), (12, 1.0), (12, 1e3)):
        name = f"{heads} MPIs, reliabilities +-{scale:g}, tau 0 to 1e4"
        blending.append((name, shares, partial(_blending, heads, scale)))
    in_half = shares + " (gradient of R: as bfloat16 holds it)"
    blending += [
        ("3 MPIs, reliabilities 1,000 +- 1", shares, partial(_blending, 3, 1.0, level=1e3)),
        ("1 MPI (K = 1)", "exactly tau", partial(_blending, 1, 1e3)),
        ("reliabilities in bfloat16", in_half, partial(_blending, 4, 3.0, half=True)),
        ("12 MPIs that tie at -1e3 to 1e3", "P = 1/12 to 4 roundings", partial(_ties, 12)),
        ("sole cover, the others hold NaN, +-inf, 1e30", "exactly tau, gradients 1 and 0", _sole),
    ]
    rays = {
        "alpha 0 everywhere": np.zeros((4, 300)),
        "alpha 1 everywhere (tau = 1e4)": np.full((4, 300), 1e4),
        "optical depths 1e-12 to 1e-4": _mixed(-12, -4),
        "optical depths 1e-6 to 10": _mixed(-6, 1),
        "optical depths 1e-30 to 1e4": _mixed(-30, 4),
        "10,000 samples of mean depth 1e-6": _long(1e-6),
        "10,000 samples of mean depth 1e-3, the 9,000th opaque": _long(1e-3, 9000),
        "10,000 samples of mean depth 1": _long(1.0),
        "10,000 equal samples that let 1e-30 through": np.full((2, LONG), math.log(1e30) / LONG),
        "transmittance 1e-30 before the last of 64 samples": _before_last(1e-30),
        "transmittance 1e-43 (no normal float32 number) before the last": _before_last(1e-43),
    }
    compositing = [(name, composited, partial(_composite, taus)) for name, taus in rays.items()]
    compositing += [
        ("half of 300 samples dropped", composited, partial(_composite, _mixed(-4, 0), dropped=True)),
        ("NaN, inf, 1e30 behind the last ray", "as if they were not there", _behind),
        ("rays that meet nothing", "black, transparent, 1/t = 0", _nothing),
        ("median distance in 10,000 samples", "half of the mass, to 17 roundings", _median),
    ]
    groups = {"density": density, "blending": blending, "compositing": compositing}
    return [Case(group, *row) for group, rows in groups.items() for row in rows]
