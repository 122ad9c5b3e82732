"""Training pixels in memory, from which batches are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, Int16, UInt8
from torch import Tensor

from mmpi_ns.capture.dataset import MMPIDataset
from mmpi_ns.capture.known_depth import KnownDepth, unpacked
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.random_draws import generator


@dataclass(frozen=True)
class PixelPool:
    """The pixels P of some images, image by image, on the device; those of images I are drawn.

    If all pixels of an image are here, row and column of a pixel follow from its index.
    """

    colors: UInt8[Tensor, "P C"]
    """C = 3 or 4."""
    images: Int[Tensor, "I"]
    """Numbers of the images in the data set."""
    widths: Int[Tensor, "I"]
    begins: Int[Tensor, "I"]
    """Index of each image's first pixel."""
    ends: Int[Tensor, "I"]
    places: Int[Tensor, "P"] | None
    """row * width + column of each pixel; None if all pixels are here."""
    depths: Int16[Tensor, "P 2"] | None
    """Inverse distance of each pixel and its expected error, as ``known_depth.packed``; None if none is known."""

    @staticmethod
    def from_dataset(
        dataset: MMPIDataset,
        device: str | torch.device,
        images: Sequence[int] | None = None,
        known_depth: KnownDepth | None = None,
        most: int = 0,
        seed: int = 0,
    ) -> PixelPool:
        """Reads images once; masked pixels are left out.

        Args:
            dataset: the training images.
            device: of the pixels.
            images: which of them; None for all.
            known_depth: their depths.
            most: maximum number of pixels; beyond it, a random subset, the same fraction of each image. 0: no limit.
            seed: of the subset.

        Raises:
            InputError: an image or mask cannot be used (names the file), or the masks leave nothing.
        """
        images = range(len(dataset)) if images is None else images
        widths, heights = (x.reshape(-1).tolist() for x in (dataset.cameras.width, dataset.cameras.height))
        sizes = [widths[i] * heights[i] for i in images]
        share = min(1.0, most / sum(sizes)) if most else 1.0
        whole = share == 1.0 and not dataset.has_masks
        room = sum(int(share * size) for size in sizes)
        colors = torch.empty(room, 4 if dataset.has_alpha else 3, dtype=torch.uint8)
        places = None if whole else torch.empty(room, dtype=torch.int32)
        depths = None if known_depth is None else torch.empty(room, 2, dtype=torch.int16)
        starts = [0]
        for i in images:
            image, kept = _pixels_of(dataset, i, share, seed)
            starts.append(starts[-1] + len(kept))
            rows = slice(*starts[-2:])
            colors[rows, : image.shape[1]] = image[kept]
            colors[rows, image.shape[1] :] = 255  # opaque where the image has no alpha and another one has
            if places is not None:
                places[rows] = kept.int()
            if depths is not None and known_depth is not None:
                depths[rows] = torch.from_numpy(np.require(known_depth.codes[i], requirements="W")).reshape(-1, 2)[kept]
        if not starts[-1]:
            raise InputError("The masks leave no training pixel: white (non-zero) mask pixels are the ones used.")
        rows = slice(starts[-1])
        places, depths = (None if x is None else x[rows].to(device) for x in (places, depths))
        columns = list(images), [widths[i] for i in images], starts[:-1], starts[1:]
        tables = (torch.tensor(column, device=device) for column in columns)
        return PixelPool(colors[rows].to(device), *tables, places, depths)

    @cached_property
    def count(self) -> int:
        """How many pixels are drawn from; asked of the device once, not in every step."""
        return int((self.ends - self.begins).sum())

    def draw(
        self, count: int, g: torch.Generator
    ) -> tuple[Float[Tensor, "R C"], Int[Tensor, "R 3"], Float[Tensor, "R 2"]]:
        """Colours, (image, row, column) and depths of random pixels.

        Args:
            count: R.
            g: draws them.
        """
        after = (self.ends - self.begins).cumsum(0)
        drawn = torch.randint(self.count, (count,), generator=g, device=g.device).to(self.colors.device)
        which = torch.searchsorted(after, drawn, right=True)
        chosen = drawn - after[which] + self.ends[which]
        place = chosen - self.begins[which] if self.places is None else self.places[chosen].long()
        width = self.widths[which]
        indices = torch.stack([self.images[which], place // width, place % width], -1)
        nothing = torch.zeros(count, 2, device=self.colors.device)
        depths = nothing if self.depths is None else unpacked(self.depths[chosen])
        return self.colors[chosen].float() / 255, indices, depths

    def of_images(self, images: Int[Tensor, "A"]) -> PixelPool:
        """Draws from some of the images, given by their numbers; shares the pixels.

        Raises:
            InputError: they have no pixel here.
        """
        kept = (torch.isin(self.images, images.to(self.images)) & (self.ends > self.begins)).nonzero()[:, 0]
        if not len(kept):
            raise InputError("The masks leave no training pixel in one stretch of the capture: use longer windows.")
        return replace(self, **{name: getattr(self, name)[kept] for name in ("images", "widths", "begins", "ends")})

    @property
    def nbytes(self) -> int:
        """Bytes of the pixels themselves."""
        return sum(x.nbytes for x in (self.colors, self.places, self.depths) if x is not None)


def _pixels_of(dataset: MMPIDataset, i: int, share: float, seed: int) -> tuple[UInt8[Tensor, "N C"], Int[Tensor, "n"]]:
    """The pixels of an image, and the indices to keep: a fraction of those that no mask hides."""
    data = dataset.get_data(i, image_type="uint8")
    image = data["image"].reshape(-1, data["image"].shape[-1])
    kept = torch.arange(len(image))
    if share < 1:
        kept = torch.randperm(len(image), generator=generator(seed, i, "resident"))[: int(share * len(image))]
        kept = kept.sort().values
    if "mask" in data:
        kept = kept[data["mask"].reshape(-1).bool()[kept]]
    return image, kept
