"""A whole ray through a field, exactly: every sample by loops in float64, with the gradient of every table.

The field comes in as its plan and plain arrays (``ExactField.of`` slices the pooled tables by the layout that
``texels.py`` documents); lookups, networks and their derivatives are written out here a second time.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from stability import exact
from stability.exact import STILL, Array, Jitter

from mmpi_ns.scene.plan import MPIPlan, ScenePlan

Corners = list[tuple[tuple[int, ...], float]]
"""Indices of texels, and their weights."""
TABLES = ("density", "features", "reliability", "networks")


@dataclass(frozen=True)
class ExactField:
    """A field as arrays."""

    plan: ScenePlan
    tables: dict[str, list[Array]]
    """By name, of each head: [planes, height, width, channels]; of the networks [N, weights], a row a head or one."""
    layers: list[tuple[int, ...]]
    """Shapes of weights and biases in a network's row."""
    frequencies: tuple[int, int]
    shading: str
    """Whether a network is asked once a ray or for every sample."""
    depth_scale: float
    samples_per_voxel: float
    cube_alpha: float

    @staticmethod
    def of(source) -> ExactField:
        """The state of an ``MMPIField``, in float64."""

        def split(name: str) -> list[Array]:
            flat = getattr(source, name).detach().double().cpu()
            return [flat[g.rows].view(g.depth, g.height, g.width, -1).numpy() for g in source.grids]

        networks = source.networks
        tables = {name: split(name) for name in (*TABLES[:3], "touched")}
        tables["networks"] = [networks.weights.detach().double().cpu().numpy()]
        frequencies = (0, *networks.frequencies)[-2:]
        numbers = source.shading, source.layout.depth_scale, source.samples_per_voxel, source.cube_alpha
        return ExactField(source.plan, tables, list(networks.shapes), frequencies, *numbers)


class Gradients:
    """Derivatives by every table of a field, and the magnitudes that each is made of, in the tables' shapes."""

    def __init__(self, field: ExactField) -> None:
        self.sums, self.sizes = ({n: [np.zeros_like(t) for t in field.tables[n]] for n in TABLES} for _ in range(2))

    def add(self, name: str, head: int, corners: Corners, value: Array | float, size: Array | float) -> None:
        """Adds what a lookup's gradient is to the texels that were read."""
        for index, weight in corners:
            self.sums[name][head][index] += weight * value
            self.sizes[name][head][index] += weight * np.abs(size)

    @staticmethod
    def flat(tables: dict[str, list[Array]], name: str) -> Array:
        """One table's sums or sizes, [texels, channels], head by head in reading order."""
        return np.concatenate([t.reshape(-1, t.shape[-1]) for t in tables[name]])


@dataclass(frozen=True)
class Sample:
    """One head's sample on a ray, before blending, and where it was looked up."""

    head: int
    plane: int
    inverse_t: float
    size_q: float
    """Magnitudes that 1/t is made of."""
    raw: float
    """Interpolated density plus bias."""
    scale: float
    """Factor on softplus."""
    tau: float
    votes: Array
    cover: NDArray[np.bool_]
    inputs: Array
    """Of the colour network."""
    color: Array
    corners: Corners
    vote_corners: list[Corners]


@dataclass
class ExactRay:
    """All samples of one ray, nearest first, and how close any decision about them was."""

    field: ExactField
    origin: Array
    direction: Array
    near: float = 0.05
    far: float = math.inf
    jitter: Jitter = STILL
    votes: bool = True
    """Whether reliability is asked for; where it takes no part that changes nothing."""
    margin: float = math.inf
    samples: list[Sample] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        plan = self.field.plan
        for k, mpi in enumerate(plan.mpis):
            # Which samples there are, and their order, is decided by exact numbers; only what they read is moved.
            met = exact.cross(mpi, self.origin, self.direction, self.near, self.far)
            moved = exact.cross(mpi, self.origin, self.direction, self.near, self.far, self.jitter)
            self.margin = min(self.margin, float(met.margin.min()))
            for plane in np.nonzero(met.live)[0]:
                ndc = exact.to_ndc(mpi, moved.u[plane], moved.v[plane], exact.disparities(mpi)[plane])
                q = float(met.inverse_t[plane]), float(met.size_q[plane])
                self.samples.append(self._sample(k, int(plane), q, ndc))
        if plan.cube is not None:
            sides = [
                (b - a) / (n - 1)
                for a, b, n in zip(plan.cube.lower, plan.cube.upper, plan.cube.shape[::-1], strict=True)
            ]
            step = min(sides) / self.field.samples_per_voxel
            found, margin = exact.cube_steps(plan.cube, step, self.origin, self.direction, self.near, self.far)
            self.margin = min(self.margin, margin)
            for i in found:
                t = (i + 0.5) * step
                self.samples.append(self._sample(len(plan.mpis), i, (1 / t, 1 / t), self._in_cube(1 / t)))
        self.samples.sort(key=lambda s: (-s.inverse_t, s.head, s.plane))
        for a, b in itertools.pairwise(self.samples):
            if a.head != b.head and a.inverse_t != b.inverse_t:
                self.margin = min(self.margin, (a.inverse_t - b.inverse_t) / (a.size_q + b.size_q))

    def _in_cube(self, inverse_t: float) -> Array:
        assert self.field.plan.cube is not None
        lower, upper = np.array(self.field.plan.cube.lower), np.array(self.field.plan.cube.upper)
        point = self.origin + self.direction / inverse_t
        return self.jitter(2 * (point - lower) / (upper - lower) - 1, 1.0 + np.abs(point / (upper - lower)))

    def _sample(self, k: int, plane: int, q: tuple[float, float], ndc: Array) -> Sample:
        f, plan, (inverse_t, size_q) = self.field, self.field.plan, q
        densities = f.tables["density"][k]
        if k < len(plan.mpis):
            mpi = plan.mpis[k]
            corners = [((plane, *at), w) for at, w in corners_of(ndc[1::-1], densities.shape[1:3])]
            axes, step = np.array(mpi.axes), (1 / mpi.near - 1 / mpi.far) / (mpi.planes - 1)
            bias, scale = exact.plane_bias(mpi.planes, 1 / mpi.far / step)[0][plane], 256 / mpi.planes * f.depth_scale
        else:
            corners, axes = corners_of(ndc[::-1], densities.shape[:3]), np.eye(3)
            scale = 1 / f.samples_per_voxel
            bias = math.log(math.expm1(-math.log1p(-f.cube_alpha) / scale))
        raw = self._read(densities, corners, abs(bias))[0] + bias
        features = self._read(f.tables["features"][k], corners)
        votes, cover, vote_corners = self._votes(k, inverse_t, ndc)
        tau = float(self.jitter(exact.softplus(raw) * scale))
        inputs, color = features, exact.sigmoid(features[:3])
        if f.shading == "sample":
            inputs = self._encode((ndc, axes @ self.direction), features)
            color = exact.sigmoid(features[:3] + self._network(k, inputs)[0])
        return Sample(k, plane, inverse_t, size_q, raw, scale, tau, votes, cover, inputs, color, corners, vote_corners)

    def _read(self, table: Array, corners: Corners, more: float = 0.0) -> Array:
        """A lookup. Its position is known to a rounding of 1: times the texels across, that moves it by its texels."""
        size = max(table.shape[:3]) * np.max([np.abs(table[index]) for index, _ in corners], axis=0)
        return self.jitter(np.sum([weight * table[index] for index, weight in corners], axis=0), size + more)

    def _votes(self, own: int, inverse_t: float, own_ndc: Array):
        """Reliability of every head at a sample, which of them cover it, and the texels that were read."""
        plan, tables = self.field.plan, self.field.tables
        if not self.votes:
            return np.zeros(plan.num_heads), np.arange(plan.num_heads) == own, [[]] * plan.num_heads
        votes, cover, read = [], [], []
        for j in range(plan.num_heads):
            if j == own:
                ndc, size = own_ndc, 1.0
            elif j < len(plan.mpis):
                found = exact.place_in(plan.mpis[j], self.origin, self.direction, inverse_t, self.jitter)
                ndc, size = found if found is not None else (None, 1.0)
            else:
                ndc, size = (self._in_cube(inverse_t) if inverse_t > 0 else None), 4.0
            covers = j == own
            if max(own, j) < len(plan.mpis) and _same_frame(plan.mpis[j], plan.mpis[own]):
                # The border that a sample may lie on is its own.
                ndc, covers = own_ndc, True
            elif ndc is not None and j != own:
                gaps = np.abs(np.abs(ndc) - 1)[: 2 if inverse_t == 0 else 3]
                self.margin = min(self.margin, float(gaps.min()) / size)
                covers = bool((np.abs(ndc) <= 1 + 1e-12).all())
            if ndc is None or not covers:
                votes.append(0.0)
                cover.append(False)
                read.append([])
                continue
            corners = corners_of(np.clip(ndc, -1, 1)[::-1], tables["reliability"][j].shape[:3])
            touched = tables["touched"][j]
            nearest, gap = _nearest(ndc[::-1], touched.shape[:3])
            trained = bool(touched[nearest][0])
            self.margin = min(self.margin, gap) if not touched.all() else self.margin
            votes.append(float(self._read(tables["reliability"][j], corners)[0]))
            cover.append(j == own or trained)
            read.append(corners)
        return np.array(votes), np.array(cover), read

    # Colour networks -----------------------------------------------------------------------------------------

    def _encode(self, vectors: tuple[Array, ...], features: Array) -> Array:
        """Network inputs from features and positional encodings; the last of the vectors is a direction."""
        parts, vectors = [features], (*vectors[:-1], self.jitter(vectors[-1], 1.0))
        for x, count in zip(vectors, self.field.frequencies[-len(vectors) :], strict=True):
            angles = np.concatenate([x * math.pi * 2**i for i in range(count)]) if count else np.zeros(0)
            parts += [x, np.sin(angles), np.cos(angles)]
        return np.concatenate(parts)

    def _row(self, head: int) -> int:
        return head if len(self.field.tables["networks"][0]) > 1 else 0

    def _weights(self, head: int) -> list[Array]:
        row = self.field.tables["networks"][0][self._row(head)]
        ends = np.cumsum([math.prod(s) for s in self.field.layers])
        return [part.reshape(s) for part, s in zip(np.split(row, ends[:-1]), self.field.layers, strict=True)]

    def _network(self, head: int, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """Three numbers, hidden layers, and the network's inputs as it may have rounded them."""
        w1, b1, w2, b2, w3, b3 = self._weights(head)
        move = self.jitter.network
        x = move(inputs)
        h1 = move(np.maximum(move(w1 @ x + b1, np.abs(w1) @ np.abs(x) + np.abs(b1)), 0))
        h2 = move(np.maximum(move(w2 @ h1 + b2, np.abs(w2) @ np.abs(h1) + np.abs(b2)), 0))
        logits = move(w3 @ h2 + b3, np.abs(w3) @ np.abs(h2) + np.abs(b3))
        return logits, h1, h2, x

    # Rendering -----------------------------------------------------------------------------------------------

    def blended(self, blends: bool) -> list[exact.Blended]:
        return [exact.blend(s.tau, s.votes, s.cover, s.head, blends) for s in self.samples]

    def render(self, blends: bool = False) -> tuple[Array, exact.Composited]:
        """Colour [3] without background, and weights and transmittance."""
        made = exact.composite(np.array([b.depth for b in self.blended(blends)]))
        if self.field.shading == "ray":
            return self._shaded_once(made), made
        color = np.zeros(3)
        for weight, sample in zip(made.weights, self.samples, strict=True):
            color = color + weight * sample.color
        return color, made

    def _shaded_once(self, made: exact.Composited) -> Array:
        """What a ray shows whose colours and features are gathered before a network shades them."""
        if not self.samples:
            return np.zeros(3)
        each = np.array([np.concatenate([s.color, np.tanh(s.inputs[3:])]) for s in self.samples])
        mean = made.weights @ each / max(float(made.weights.sum()), 1e-6)
        change = 4 * self._network(0, self._encode((self.direction,), mean))[0]
        odds = np.exp(8 * np.tanh(change / 8)) * mean[:3]
        return made.accumulation * odds / (odds + 1 - mean[:3])

    def add_gradient(self, by_color: Array, blends: bool, total: Gradients) -> None:
        """Adds the derivatives of ``by_color`` . colour, and the magnitudes of all that is added."""
        blended = self.blended(blends)
        taus = np.array([b.depth for b in blended])
        made = exact.composite(taus)
        by_weight = np.array([float(by_color @ s.color) for s in self.samples])
        by_depth = exact.composite_gradient(taus, by_weight, 0.0)
        sizes = exact.composite_gradient(taus, np.abs(by_weight), 0.0)
        # Both terms of that difference count: the light that a sample stops and what it takes from those behind.
        sizes = np.abs(sizes) + 2 * float(np.abs(by_weight) @ made.weights)
        for i, (s, b) in enumerate(zip(self.samples, blended, strict=True)):
            raw = b.by_tau * s.scale * float(exact.sigmoid(s.raw))
            total.add("density", s.head, s.corners, by_depth[i] * raw, sizes[i] * raw)
            for j, (slope, corners) in enumerate(zip(b.by_reliability, s.vote_corners, strict=True)):
                total.add("reliability", j, corners, by_depth[i] * slope, sizes[i] * slope)
            self._add_color(s, by_color * made.weights[i], total)

    def _add_color(self, s: Sample, by_color: Array, total: Gradients) -> None:
        """Backwards through a colour network."""
        channels = self.field.tables["features"][s.head].shape[-1]
        logits, h1, h2, x = self._network(s.head, s.inputs)
        color = exact.sigmoid(s.inputs[:3] + logits)
        by_logit = by_color * color * (1 - color)
        for sums, (w1, _, w2, _, w3, _), by in (
            (total.sums, self._weights(s.head), by_logit),
            (total.sizes, [np.abs(w) for w in self._weights(s.head)], np.abs(by_logit)),
        ):
            # The magnitudes go the same way as the derivatives; all inputs count with theirs.
            a, b, c = (x, h1, h2) if sums is total.sums else (np.abs(x), h1, h2)
            by_h2 = (w3.T @ by) * (h2 > 0)
            by_h1 = (w2.T @ by_h2) * (h1 > 0)
            by_features = (w1.T @ by_h1)[:channels]
            by_features[:3] += by
            for index, weight in s.corners:
                sums["features"][s.head][index] += weight * by_features
            parts = [np.outer(by_h1, a), by_h1, np.outer(by_h2, b), by_h2, np.outer(by, c), by]
            sums["networks"][0][self._row(s.head)] += np.concatenate([p.reshape(-1) for p in parts])


# Lookups -------------------------------------------------------------------------------------------------------------


def _same_frame(a: MPIPlan, b: MPIPlan) -> bool:
    return (a.origin, a.axes, a.near, a.far, a.extent) == (b.origin, b.axes, b.near, b.far, b.extent)


def corners_of(position: Sequence[float] | Array, shape: tuple[int, ...]) -> Corners:
    """(index, weight) of the texels around a position in [-1, 1]^D; corners of the range are texel centres."""
    axes = []
    for x, n in zip(position, shape, strict=True):
        at = min(max((float(x) + 1) / 2 * (n - 1), 0.0), n - 1.0)
        lower = min(math.floor(at), n - 2)
        axes.append(((lower, 1 - (at - lower)), (lower + 1, at - lower)))
    return [
        (tuple(i for i, _ in corner), math.prod(weight for _, weight in corner)) for corner in itertools.product(*axes)
    ]


def _nearest(position: Array, shape: tuple[int, ...]) -> tuple[tuple[int, ...], float]:
    """Index of the nearest texel, and how far the closest choice was from a tie, relative to the side."""
    at = [min(max((float(x) + 1) / 2 * (n - 1), 0.0), n - 1.0) for x, n in zip(position, shape, strict=True)]
    gap = min(abs(a % 1 - 0.5) / n for a, n in zip(at, shape, strict=True))
    return tuple(round(a) for a in at), gap
