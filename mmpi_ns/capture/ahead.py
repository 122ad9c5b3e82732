"""The rays of the next step are drawn while a step runs."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar

import torch
from nerfstudio.cameras.rays import RayBundle

from mmpi_ns.capture.ray_sources import RaySources
from mmpi_ns.utils.parallel import num_threads
from mmpi_ns.utils.random_draws import generator

Batch = tuple[RayBundle, dict[str, Any]]


class DrawnAhead:
    """Draws the rays of steps, keyed on (seed, step); with several threads, one of them draws those of the next step
    meanwhile. Drawing is small operations of torch, which take the time of one core."""

    _thread: ClassVar = ThreadPoolExecutor(1, thread_name_prefix="mmpi-rays")

    def __init__(self, seed: int, device: str | torch.device) -> None:
        self.seed, self.device = seed, device
        self._next: tuple[RaySources, tuple[int, int], Future[Batch]] | None = None

    def draw(self, sources: RaySources, step: int, pixel_rays: int) -> Batch:
        """What ``RaySources.draw`` draws for a step.

        Args:
            sources: of the rays.
            step: of the training.
            pixel_rays: rays through pixels.
        """
        batch = None
        if self._next is not None:
            of, key, future = self._next
            batch = future.result() if of is sources and key == (step, pixel_rays) else None
        batch = batch or self._drawn(sources, step, pixel_rays)
        if num_threads() > 1 and torch.device(self.device).type == "cpu":
            following = step + 1, pixel_rays
            self._next = sources, following, self._thread.submit(self._drawn, sources, *following)
        return batch

    def _drawn(self, sources: RaySources, step: int, pixel_rays: int) -> Batch:
        return sources.draw(pixel_rays, generator(self.seed, step, "pixels", self.device))
