"""The middle line of a road: straight, or a smooth bending curve of any length."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP = 0.5
"""Metres of x between the knots of the table of arc lengths."""


@dataclass(frozen=True)
class Road:
    """A curve y(x), a sum of waves, and the widths of the street along it. Metres.

    A graph over x, so that a place on the ground finds its place along the road at once, however long the road is.
    """

    length: float
    """Metres driven; the road goes on before and beyond."""
    waves: tuple[tuple[float, float, float], ...] = ()
    """(amplitude, wavelength, phase) of each wave; none: straight along x."""
    before: float = 30.0
    beyond: float = 330.0
    half_width: float = 3.6
    """From the middle line to the edge of the carriageway."""
    kerb: float = 5.7
    """... to the kerb; cars are parked between."""
    pavement: float = 8.6
    """... to the house fronts."""

    def curve(self, x: Array) -> tuple[Array, Array]:
        """The curve's y and slope at x."""
        turns = [(a, w, 2 * np.pi * x / w + p) for a, w, p in self.waves]
        slopes = (a * 2 * np.pi / w * np.cos(turn) for a, w, turn in turns)
        return sum((a * np.sin(turn) for a, _, turn in turns), np.zeros_like(x)), sum(slopes, np.zeros_like(x))

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Knots x and the arc length from x = 0 there."""
        x = np.arange(-self.before - 50, self.length + self.beyond + 50, STEP)
        # Simpson's rule on each interval.
        speed = [np.hypot(1, self.curve(x + k * STEP / 2)[1]) for k in range(3)]
        arc = np.concatenate([[0.0], np.cumsum(STEP / 6 * (speed[0] + 4 * speed[1] + speed[2]))[:-1]])
        return x, arc - np.interp(0.0, x, arc)

    def at(self, along: Array, aside: Array | float = 0.0) -> tuple[Array, Array]:
        """Places [N, 2] at arc lengths, ``aside`` to the left of the middle line, and the headings there [N]."""
        x, arc = self._table
        x = np.interp(along, arc, x)
        y, slope = self.curve(x)
        heading, middle = np.arctan(slope), np.stack([x, y], -1)
        return middle + np.stack([-np.sin(heading), np.cos(heading)], -1) * np.asarray(aside)[..., None], heading

    def locate(self, places: Array) -> tuple[Array, Array, Array]:
        """Arc length, distance to the left of the middle line, and heading [N] of places [N, 2] near the road."""
        if not self.waves:
            return places[:, 0], places[:, 1], np.zeros(len(places))
        foot = places[:, 0]
        for _ in range(2):
            y, slope = self.curve(foot)
            # Newton on the foot of the perpendicular; the second derivative is left out, as bends are wide.
            foot = foot + ((places[:, 0] - foot) + (places[:, 1] - y) * slope) / (1 + slope**2)
        x, arc = self._table
        y, slope = self.curve(foot)
        heading, offset = np.arctan(slope), places - np.stack([foot, y], -1)
        aside = offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading)
        return np.interp(foot, x, arc), aside, heading
