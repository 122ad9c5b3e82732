"""Stability of densities, shares and compositing: values and gradients against decimals and float64."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from mmpi_ns.bench.stability import exact
from mmpi_ns.bench.stability.cases import Case, Error, Outcome, Precision, compare, plan_of, random_mpi, single
from mmpi_ns.bench.stability.exact import Array
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.ops.blending import BlendForm, blend_shares, blended_optical_depth
from mmpi_ns.ops.composite.reference import composite_weights, median_inverse_distance, render_colors

# Densities -----------------------------------------------------------------------------------------------------------

DENSITY = "tau and d tau to 16 roundings of the numbers added"


def _density(raw: Array, planes: int, precision: Precision) -> Outcome:
    """tau = softplus(raw + b_l) 256 / L on every plane, for every raw density."""
    rng = np.random.default_rng(0)
    field = MMPIField(plan_of([random_mpi(rng, planes)]), feature_channels=3, hidden_width=4)
    values = np.tile(single(raw), planes)
    index = np.repeat(np.arange(planes), len(raw))
    given = torch.tensor(values, dtype=torch.float32, requires_grad=True)
    with precision.context():
        tau = field.layout.optical_depth(0, given, torch.tensor(index))
        tau.sum().backward()
    assert given.grad is not None
    bias, interval = exact.plane_bias(planes)
    x = values + bias[index]
    slope, size = exact.sigmoid(x) * interval, np.abs(values) + np.abs(bias[index]) + 1
    # d sigmoid = sigmoid (1 - sigmoid) dx <= sigmoid dx.
    return Outcome(
        compare(tau, exact.softplus(x) * interval, exact.softplus(x) * interval + slope * size, 16),
        compare(given.grad, slope, slope * size, 16),
    )


def _equal_start(planes: int, precision: Precision) -> Outcome:
    """A new MPI gives every plane the weight 1/L (the last one 0.999 of what is left)."""
    rng = np.random.default_rng(0)
    field = MMPIField(plan_of([random_mpi(rng, planes)]), feature_channels=3, hidden_width=4)
    index = torch.arange(planes)
    with precision.context():
        tau = field.layout.optical_depth(0, torch.zeros(planes), index)[None]
        made = composite_weights(
            tau, torch.ones_like(tau, dtype=torch.bool), torch.zeros_like(tau), torch.zeros_like(tau[:, :1])
        )
    wanted = np.full(planes, 1 / planes)
    wanted[-1] *= 0.999
    # log(e^b - 1) is rounded once, at magnitudes up to |b|; the depths in front add up to log L.
    size = wanted * (1 + np.abs(exact.plane_bias(planes)[0]).max() + math.log(planes))
    return Outcome(compare(made.weights[0], wanted, size, 16))


# Shares and blended depths -------------------------------------------------------------------------------------------

SHARES = "tau', d tau' / d tau, d tau' / d R to 16 roundings of the differences of reliabilities"


def _votes(
    rng: np.random.Generator, samples: int, heads: int, scale: float, level: float
) -> tuple[Array, Array, Array]:
    own = rng.integers(0, heads, samples)
    cover = rng.random((samples, heads)) < 0.7
    cover[np.arange(samples), own] = True
    return single(level + rng.normal(size=(samples, heads)) * scale), cover, own


def _blending(
    heads: int,
    scale: float,
    form: BlendForm,
    precision: Precision,
    level: float = 0.0,
    taus: tuple[float, ...] = (0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 5.0, 30.0, 90.0, 1e4),
    half: bool = False,
) -> Outcome:
    rng = np.random.default_rng(heads)
    reliability, cover, own = _votes(rng, 40 * len(taus), heads, scale, level)
    tau = single(np.resize(np.array(taus), len(own)))
    given = torch.tensor(reliability, dtype=torch.float32).to(torch.bfloat16 if half else torch.float32)
    reliability = given.double().numpy()
    given.requires_grad_()
    depth = torch.tensor(tau, dtype=torch.float32, requires_grad=True)
    with precision.context():
        shares = blend_shares(given, torch.tensor(cover), torch.tensor(own))
        blended = blended_optical_depth(depth, *shares, form)
        blended.sum().backward()
    assert given.grad is not None and depth.grad is not None
    wanted = [exact.blend(t, r, c, int(o), form) for t, r, c, o in zip(tau, reliability, cover, own, strict=True)]
    value = np.array([w.depth for w in wanted])
    by_tau = np.array([w.by_tau for w in wanted])
    by_vote = np.array([w.by_reliability for w in wanted])
    highest = np.where(cover, reliability, -np.inf).max(-1)
    spread = 1 + highest - np.where(cover, reliability, np.inf).min(-1)
    share = np.array([float(exact.shares(r, c, int(o))[0][o]) for r, c, o in zip(reliability, cover, own, strict=True)])
    # A log share is a difference of reliabilities, so it is known to a rounding of their spread; it scales tau' of a
    # thin sample, and moves -log(1 - alpha') of an opaque one by at most as much.
    size = value + np.minimum(value, 1) * spread + by_tau * tau
    size_votes = np.abs(by_vote).max(-1, keepdims=True) * (spread + tau * (tau < 88))[:, None]
    unit = 2.0**-9 / 2.0**-24 if half else 1.0  # the gradient of a bfloat16 number is stored in bfloat16
    return Outcome(
        compare(blended, value, size, 16),
        Error.worst(
            [
                compare(depth.grad, by_tau, by_tau * (spread + tau) + share, 16),
                compare(given.grad.double(), by_vote, size_votes, 16 * max(1.0, unit / 8)),
            ]
        ),
    )


def _ties(heads: int, precision: Precision) -> Outcome:
    """Equal reliabilities of any size share equally: P = 1/K."""
    levels = single(np.array([-1e3, -40.0, 0.0, 17.0, 1e3]))
    reliability = torch.tensor(np.repeat(levels, heads), dtype=torch.float32).view(-1, heads)
    own = torch.arange(len(levels)) % heads
    with precision.context():
        log_share, log_rest = blend_shares(reliability, torch.ones_like(reliability, dtype=torch.bool), own)
    wanted = np.full(len(levels), -math.log(heads))
    rest = np.full(len(levels), math.log1p(-1 / heads))
    return Outcome(Error.worst([compare(log_share, wanted, 1.0, 4), compare(log_rest, rest, 1.0, 4)]))


def _sole(precision: Precision) -> Outcome:
    """A sole cover keeps exactly tau whatever the others hold, NaN and infinity included; its votes get no gradient."""
    junk = [1e30, -math.inf, math.inf, math.nan, 0.0, -1e3]
    reliability = torch.tensor([[5.0, j] for j in junk], requires_grad=True)
    tau = torch.tensor([0.0, 1e-30, 1e-7, 3.0, 88.0, 1e4], requires_grad=True)
    cover = torch.tensor([[True, False]] * len(junk))
    with precision.context():
        blended = blended_optical_depth(
            tau, *blend_shares(reliability, cover, torch.zeros(len(junk), dtype=torch.long))
        )
        blended.sum().backward()
    assert reliability.grad is not None and tau.grad is not None
    return Outcome(
        compare(blended, tau.detach().double().numpy(), 1.0, 0),
        Error.worst(
            [compare(tau.grad, np.ones(len(junk)), 1.0, 0), compare(reliability.grad, np.zeros((len(junk), 2)), 1.0, 0)]
        ),
    )


# Compositing ---------------------------------------------------------------------------------------------------------

COMPOSITE = (
    "weights, transmittance, accumulation and their gradient to 4 + log2(samples) roundings of the depth in front"
)


def _composite(taus: Array, precision: Precision, dropped: bool = False) -> Outcome:
    """Every ray [R, S]: weights, what passes, what is gathered, and the gradient of a random mixture of them."""
    rng = np.random.default_rng(5)
    taus = single(taus)
    rays, samples = taus.shape
    roundings = 4 + math.log2(samples)
    kept = rng.random(taus.shape) < 0.5 if dropped else np.ones(taus.shape, bool)
    skipped = np.where(kept, 0, taus)
    before = single(np.cumsum(skipped, -1) - skipped)
    by_weight, by_rest = single(rng.normal(size=taus.shape)), single(rng.normal(size=(rays, 1)))
    given = torch.tensor(taus, dtype=torch.float32, requires_grad=True)
    constants = [
        torch.tensor(x, dtype=torch.float32) for x in (before, skipped.sum(-1, keepdims=True), by_weight, by_rest)
    ]
    with precision.context():
        made = composite_weights(given, torch.tensor(kept), constants[0], constants[1])
        ((made.weights * constants[2]).sum() + (made.transmittance * constants[3]).sum()).backward()
    assert given.grad is not None
    errors, gradients = [], []
    for r in range(rays):
        wanted = exact.composite(taus[r])
        front = 1 - np.log(np.maximum(wanted.in_front, 1e-300))
        rest = wanted.transmittance
        errors += [
            compare(made.weights[r], np.where(kept[r], wanted.weights, 0), wanted.weights * front, roundings),
            compare(made.transmittance[r], np.array([rest]), rest * (1 + taus[r].sum()), roundings),
            compare(made.accumulation[r], np.array([wanted.accumulation]), wanted.accumulation, roundings),
        ]
        g = np.where(kept[r], by_weight[r], 0)
        slope = np.where(kept[r], exact.composite_gradient(taus[r], g, float(by_rest[r, 0])), 0)
        behind = np.abs(g * wanted.weights) * front
        size = np.abs(g) * wanted.in_front * front + np.cumsum(behind[::-1])[::-1] - behind
        size = size + np.abs(by_rest[r]) * rest * (1 + taus[r].sum())
        gradients.append(compare(given.grad[r], slope, np.maximum(size, 1e-30), 2 * roundings))
    return Outcome(Error.worst(errors), Error.worst(gradients))


def _empty_slots(precision: Precision) -> Outcome:
    """What is in an empty slot, NaN and infinity included, changes nothing and gets no gradient."""
    tau = torch.tensor([[0.3, math.nan, 0.5, math.inf, 1e30]], requires_grad=True)
    valid = torch.tensor([[True, False, True, False, False]])
    with precision.context():
        made = composite_weights(tau, valid, torch.zeros_like(tau), torch.zeros(1, 1))
        made.weights.sum().backward()
    assert tau.grad is not None
    wanted = exact.composite(single(np.array([0.3, 0.5])))
    weights = np.array([[wanted.weights[0], 0, wanted.weights[1], 0, 0]])
    slope = exact.composite_gradient(single(np.array([0.3, 0.5])), np.ones(2), 0.0)
    return Outcome(
        compare(made.weights, weights, 1.0, 4), compare(tau.grad, np.array([[slope[0], 0, slope[1], 0, 0]]), 1.0, 8)
    )


def _nothing(precision: Precision) -> Outcome:
    """A ray that meets nothing: black, transparent, infinitely far."""
    tau, valid = torch.full((3, 4), 5.0), torch.zeros(3, 4, dtype=torch.bool)
    with precision.context():
        made = composite_weights(tau, valid, torch.zeros_like(tau), torch.zeros(3, 1))
        rgb = render_colors(made, torch.rand(3, 4, 3))
        median = median_inverse_distance(made.weights, torch.ones(3, 4), valid)
    found = torch.cat([rgb, made.accumulation, made.transmittance, median], -1)
    return Outcome(compare(found, np.tile([0, 0, 0, 0, 1, 0], (3, 1)), 1.0, 0))


def _median(precision: Precision) -> Outcome:
    """1/t at half of what is gathered, in 10,000 samples; wrong is a sample whose gathered share is not half."""
    rng = np.random.default_rng(6)
    weights = single(rng.exponential(1e-4, (8, 10_000)))
    inverse_t = single(-np.sort(-rng.random((8, 10_000)), axis=-1))
    with precision.context():
        found = median_inverse_distance(
            torch.tensor(weights, dtype=torch.float32), torch.tensor(inverse_t, dtype=torch.float32),
            torch.ones(8, 10_000, dtype=torch.bool),
        )  # fmt: skip
    gathered = np.cumsum(weights, -1)
    at = [int(np.argmin(np.abs(inverse_t[r] - float(found[r])))) for r in range(8)]
    share = np.array([gathered[r, i] / gathered[r, -1] for r, i in enumerate(at)])
    step = np.array([weights[r, i] / gathered[r, -1] for r, i in enumerate(at)])
    return Outcome(compare(np.maximum(np.abs(share - 0.5) - step, 0), np.zeros(8), 1.0, 4 + math.log2(10_000)))


def _long(mean: float, opaque_at: int | None = None, rays: int = 4) -> Array:
    taus = np.random.default_rng(1).exponential(mean, (rays, 10_000))
    if opaque_at is not None:
        taus[:, opaque_at] = 1e4
    return taus


def _mixed(low: float, high: float) -> Array:
    return 10 ** np.random.default_rng(4).uniform(low, high, (40, 300))


def _composite_cases() -> list[Case]:
    inputs: list[tuple[str, Callable[[], Array]]] = [
        ("alpha 0 everywhere", lambda: np.zeros((4, 300))),
        ("alpha 1 everywhere (tau = 1e4)", lambda: np.full((4, 300), 1e4)),
        ("optical depths 1e-12 to 1e-4", lambda: _mixed(-12, -4)),
        ("optical depths 1e-6 to 10", lambda: _mixed(-6, 1)),
        ("optical depths 1e-30 to 1e4", lambda: _mixed(-30, 4)),
        ("10,000 samples of mean depth 1e-6", lambda: _long(1e-6)),
        ("10,000 samples of mean depth 1e-3, the 9,000th opaque", lambda: _long(1e-3, 9000)),
        ("10,000 samples of mean depth 1", lambda: _long(1.0)),
        ("10,000 equal samples that let 1e-30 through", lambda: np.full((2, 10_000), math.log(1e30) / 10_000)),
        ("transmittance 1e-30 before the last of 64 samples", lambda: _before_last(math.log(1e30))),
        ("transmittance 1e-43 (no normal float32 number) before the last", lambda: _before_last(math.log(1e43))),
    ]
    rows = [Case("compositing", name, COMPOSITE, lambda p, t=taus: _composite(t(), p)) for name, taus in inputs]
    name = "half of 300 samples dropped"
    return [*rows, Case("compositing", name, COMPOSITE, lambda p: _composite(_mixed(-4, 0), p, dropped=True))]


def _before_last(depth: float) -> Array:
    taus = np.full((4, 64), depth / 63)
    taus[:, -1] = [0.0, 1e-3, 1.0, 1e4]
    return taus


def cases() -> list[Case]:
    """All cases of densities, shares and compositing."""
    spread = np.random.default_rng(7).uniform(-20, 20, 200)
    rows = [
        Case("density", "raw densities -20 to 20, 64 planes", DENSITY,
             lambda p: _density(spread, 64, p)),
        Case("density", "raw densities +-1e4, +-200, +-88.7, +-20.001 (softplus' switch)", DENSITY,
             lambda p: _density(np.outer([-1, 1], [1e4, 200, 88.7, 20.001]).ravel(), 64, p)),
        Case("density", "1,024 planes, raw densities around each plane's bias", DENSITY,
             lambda p: _density(np.linspace(-15, 15, 31), 1024, p)),
        Case("density", "2 planes, released texels (-20)", DENSITY, lambda p: _density(np.array([-20.0, 0.0]), 2, p)),
        *(Case("density", f"a new MPI of {n} planes", "weight 1/L on every plane", lambda p, n=n: _equal_start(n, p))
          for n in (16, 256, 1024)),
    ]  # fmt: skip
    forms: tuple[BlendForm, ...] = ("paper", "opacity")
    for form in forms:
        for heads, scale in ((2, 1.0), (2, 1e3), (12, 1.0), (12, 1e3)):
            name = f"{heads} MPIs, reliabilities +-{scale:g}, tau 0 to 1e4, {form} form"
            rows.append(Case("blending", name, SHARES, lambda p, h=heads, s=scale, f=form: _blending(h, s, f, p)))
    rows += [
        Case("blending", "3 MPIs, reliabilities 1,000 +- 1", SHARES, lambda p: _blending(3, 1.0, "paper", p, 1e3)),
        Case("blending", "1 MPI (K = 1)", "exactly tau", lambda p: _blending(1, 1e3, "paper", p)),
        Case("blending", "reliabilities in bfloat16", SHARES + " (gradient of R: as bfloat16 holds it)",
             lambda p: _blending(4, 3.0, "paper", p, half=True)),
        Case("blending", "12 MPIs that tie at -1e3 to 1e3", "P = 1/12 to 4 roundings", lambda p: _ties(12, p)),
        Case("blending", "sole cover, the others hold NaN, +-inf, 1e30", "exactly tau, gradients 1 and 0", _sole),
    ]  # fmt: skip
    rows += _composite_cases()
    rows += [
        Case("compositing", "empty slots that hold NaN, inf, 1e30", "as if they were not there", _empty_slots),
        Case("compositing", "rays that meet nothing", "black, transparent, 1/t = 0", _nothing),
        Case("compositing", "median distance in 10,000 samples", "half of the mass, to 17 roundings", _median),
    ]
    return rows
