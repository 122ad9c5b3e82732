"""What of a plan the GPU's kernels are compiled for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from mmpi_ns.scene.plan import ScenePlan

WIDTHS = tuple(1 << n for n in range(4, 14))
"""Widths that compositing is compiled for."""


class Shapes(NamedTuple):
    """What kernels are compiled for in a run."""

    mpis: tuple[int, ...] = (2,)
    """Numbers of MPIs of the windows."""
    cube: bool = True
    blends: bool = True
    """Whether samples are blended by reliability."""
    channels: int = 8
    """Of the colour features of a texel; density and reliability have one."""
    most_samples: int = 20
    """Of a ray."""

    @staticmethod
    def of(plans: Iterable[ScenePlan], blends: bool, channels: int) -> Shapes:
        """The shapes of a run's windows."""
        plans = tuple(plans)
        mpis = tuple(sorted({len(each.mpis) for p in plans for each in (p, p.largest)}))
        cube, most = any(p.cube is not None for p in plans), max(p.largest.samples_per_ray for p in plans)
        return Shapes(mpis, cube, blends, channels, most)

    @property
    def widths(self) -> list[int]:
        """Samples of the widest ray of batches, one number for each width that compositing is compiled for."""
        return [5 * w // 8 for w in WIDTHS if w // 2 < max(self.most_samples, 10)]


SMALL = Shapes()
EVERY = (Shapes((1, 2, 5, 9, 33), most_samples=1000), Shapes((1, 4, 16, 64), cube=False, channels=9))
"""What plans commonly need: for checks that no plan asks for."""
