"""What a stability case is: an input, what should come of it, and how far from it each arithmetic may land."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import hand_made
import numpy as np
import torch
from random_scenes import Array
from torch import Tensor

from mmpi_ns.scene.plan import MPIPlan

UNIT = 2.0**-24
"""Unit roundoff of float32: the largest relative error of one rounding."""
FLOOR = 1e-37
"""Below this float32 runs out of exponents; smaller differences count as none."""


@dataclass(frozen=True)
class Precision:
    """Under which arithmetic a case runs."""

    name: str
    dtype: torch.dtype | None = None
    """Of autocast; None: off."""

    def context(self) -> AbstractContextManager:
        return contextlib.nullcontext() if self.dtype is None else torch.autocast("cpu", self.dtype)


PRECISIONS = (Precision("float32"), Precision("bfloat16 autocast", torch.bfloat16))


@dataclass(frozen=True)
class Error:
    """An error beside its bound, both in the same measure. Not finite where the result was not finite."""

    error: float
    bound: float

    @property
    def holds(self) -> bool:
        return math.isfinite(self.error) and self.error <= self.bound

    @staticmethod
    def worst(errors: list[Error]) -> Error:
        """The one that uses most of its bound."""
        return max(errors, key=lambda e: math.inf if not math.isfinite(e.error) else e.error / max(e.bound, 1e-300))


@dataclass(frozen=True)
class Outcome:
    """What a case measured; ``gradient`` is None where nothing is differentiated."""

    value: Error
    gradient: Error | None = None

    @property
    def holds(self) -> bool:
        return self.value.holds and (self.gradient is None or self.gradient.holds)

    @staticmethod
    def of(values: list[Error], gradients: list[Error] | None = None, wrong: int = 0) -> Outcome:
        """The worst of each; decisions must all be right, or they alone count."""
        if wrong:
            return Outcome(Error(float(wrong), 0.0))
        return Outcome(Error.worst(values or [Error(0.0, 0.0)]), Error.worst(gradients) if gradients else None)


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    group: str
    inputs: str
    expectation: str
    measure: Callable[[Precision], Outcome]

    @property
    def name(self) -> str:
        return f"{self.group}: {self.inputs}"


def as_array(values: Tensor | Array) -> Array:
    if isinstance(values, Tensor):
        return values.detach().double().cpu().numpy()
    return np.asarray(values, np.float64)


def float32(values: Any) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def tried(
    precision: Precision, function: Callable[..., Any], *inputs: Any, by: tuple[Any, ...] = (1.0,)
) -> tuple[list[Tensor], list[Array]]:
    """What a function makes of inputs, and how a sum of that depends on them.

    Args:
        precision: under which it runs.
        function: of tensors, to one or a tuple of them.
        inputs: arrays, which become float32, or tensors as they are.
        by: weights of the first of the results in the sum that is differentiated.

    Returns:
        The results, and a gradient by each input.
    """
    given = [(x.clone() if isinstance(x, Tensor) else float32(x)).requires_grad_() for x in inputs]
    with precision.context():
        actual = function(*given)
        results = list(actual) if isinstance(actual, tuple) else [actual]
        weights = [float32(np.broadcast_to(b, r.shape)) for r, b in zip(results, by, strict=False)]
        torch.autograd.backward(results[: len(by)], weights)
    return results, [as_array(x.grad) for x in given if x.grad is not None]


def compare(actual: Tensor | Array, wanted: Any, size: Array | float, roundings: float) -> Error:
    """Largest error in units of ``size`` (the magnitudes that a number is made of), beside ``roundings`` of them."""
    actual, wanted = as_array(actual), np.asarray(wanted, np.float64)
    if actual.shape != wanted.shape:
        raise ValueError(f"A case compares shapes {actual.shape} and {wanted.shape}.")
    if not np.isfinite(actual).all():
        return Error(math.inf, roundings * UNIT)
    gap = np.maximum(np.abs(actual - wanted) - FLOOR, 0)
    return Error(float((gap / np.maximum(size, FLOOR)).max(initial=0.0)), roundings * UNIT)


# Scenes in numbers that float32 holds exactly, so that rounding the input is not counted as an error ----------------


def single(x: Any) -> Array:
    """Rounded to float32."""
    return np.asarray(x, np.float32).astype(np.float64)


def _plain(x: Any) -> Any:
    """Rounded to float32, in plain numbers and tuples, as plans hold them."""
    return float(np.float32(x)) if np.ndim(x) == 0 else tuple(_plain(v) for v in x)


def snap(mpi: MPIPlan) -> MPIPlan:
    """The MPI with every number rounded to float32 (the axes stay orthonormal to 1e-7)."""
    return replace(mpi, **{name: _plain(getattr(mpi, name)) for name in ("origin", "axes", "near", "far", "extent")})


def random_mpi(rng: np.random.Generator, planes: int = 12, **changes: Any) -> MPIPlan:
    """An MPI within a few units of the world's origin, with an asymmetric frustum."""
    return snap(replace(hand_made.random_mpi(rng, planes=planes), **changes))


def rays_at(rng: np.random.Generator, mpis: list[MPIPlan], count: int, spread: float = 0.6) -> tuple[Array, Array]:
    """Origins around one MPI after the other, and unit directions into its frustum."""
    origins, directions = [], []
    for i in range(count):
        mpi = mpis[i % len(mpis)]
        u, v = (rng.uniform(a, b) * 0.8 for a, b in (mpi.extent[:2], mpi.extent[2:]))
        depth = mpi.near / rng.uniform(0.1, 0.9)
        target = depth * (np.array([u, v, 1.0]) @ np.array(mpi.axes))
        offset = rng.normal(size=3) * spread * mpi.near
        origins.append(single(np.array(mpi.origin) + offset))
        # From the rounded origin: far from the world's origin the rounding may be larger than the offset.
        direction = np.array(mpi.origin) + target - origins[-1]
        directions.append(single(direction / np.linalg.norm(direction)))
    return np.array(origins), np.array(directions)
