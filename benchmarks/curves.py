"""Error over time or rays: means over seeds, values between what was measured, and how one method stands to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from random_scenes import Array


@dataclass(frozen=True)
class Curve:
    """PSNR of one method on the way, mean over seeds, at N steps."""

    steps: Array
    rays: Array
    seconds: Array
    psnr: Array
    lowest: Array
    """Of all seeds."""
    highest: Array

    @staticmethod
    def of(rows: list[dict[str, Any]]) -> Curve:
        """The mean of the curves of rows that differ in their seed alone, at the steps at which all were looked at."""
        common = set.intersection(*({point["step"] for point in row["curve"]} for row in rows))

        def table(name: str) -> Array:
            rendered = [[point[name] for point in row["curve"] if point["step"] in common] for row in rows]
            return np.array(rendered, np.float64)

        psnr = table("psnr")
        seconds = table("seconds").mean(0)
        return Curve(table("step")[0], table("rays").mean(0), seconds, psnr.mean(0), psnr.min(0), psnr.max(0))

    def at(self, seconds: float) -> float | None:
        """PSNR after so long, straight over the logarithm of time; None before the first or after the last point."""
        if not self.seconds[0] <= seconds <= self.seconds[-1]:
            return None
        return float(np.interp(np.log(seconds), np.log(self.seconds), self.psnr))

    def reaches(self, psnr: float) -> float | None:
        """Seconds until the PSNR is first so high; None where it never is."""
        above = np.nonzero(self.psnr >= psnr)[0]
        if not len(above):
            return None
        i = int(above[0])
        if i == 0:
            return float(self.seconds[0])
        share = (psnr - self.psnr[i - 1]) / (self.psnr[i] - self.psnr[i - 1])
        log = np.log(self.seconds)
        return float(np.exp(log[i - 1] + share * (log[i] - log[i - 1])))

    def last_gain(self) -> float | None:
        """dB per 1,000 steps between the last two points."""
        if len(self.steps) < 2:
            return None
        return float(1000 * (self.psnr[-1] - self.psnr[-2]) / (self.steps[-1] - self.steps[-2]))


def compare(ours: list[Curve], peer: Curve, name: str) -> dict[str, float]:
    """How we stand to a peer: at equal time, and how long we take to the PSNR that the peer ends with. Of ours, runs of
    several lengths (a schedule follows the length), the best counts."""
    results: dict[str, float] = {}
    equal = min(peer.seconds[-1], max(c.seconds[-1] for c in ours))
    theirs, here = peer.at(equal), [c.at(min(equal, c.seconds[-1])) for c in ours]
    reached = [x for x in here if x is not None]
    if theirs is not None and reached:
        results |= {"equal_time_s": float(equal), "delta_at_equal_time_db": max(reached) - theirs}
    times = [t for t in (c.reaches(float(peer.psnr[-1])) for c in ours) if t is not None]
    if times:
        results[f"seconds_to_{name}_psnr"] = min(times)
        results[f"time_ratio_to_{name}_psnr"] = float(peer.seconds[-1]) / min(times)
    gain = peer.last_gain()
    if gain is not None:
        results[f"{name}_last_gain_db_per_1000_steps"] = gain
    return results
