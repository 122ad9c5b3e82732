"""A picture of what moves in the images of a capture, for reports."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

SHOWN, COLUMNS, WIDTH = 24, 4, 320
"""Images in the picture, those in a row, and pixels across each."""
RED = (0, 0, 127)
"""Blue, green, red that half of a masked pixel's colour is replaced by."""


def draw_moving(
    path: Path, images: Iterable[tuple[str, UInt8[ndarray, "H W 3"]]], masks: Sequence[Bool[ndarray, "H W"]]
) -> None:
    """Writes the images in which most moves, in order, with what moves in red.

    Args:
        path: file of the picture; its folder is made.
        images: name, and blue, green and red of each image.
        masks: what moves in each image; something in at least one.
    """
    shares = [float(mask.mean()) for mask in masks]
    most = {i for i in sorted(range(len(masks)), key=lambda i: -shares[i])[:SHOWN] if shares[i] > 0}
    tiles = []
    for name, color, mask in ((*image, masks[i]) for i, image in enumerate(images) if i in most):
        shown = color.copy()
        shown[mask] = shown[mask] // 2 + np.array(RED, np.uint8)
        height = round(WIDTH * color.shape[0] / color.shape[1])
        tile = np.asarray(cv2.resize(shown, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
        cv2.putText(tile, name, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 255, 255), 1)
        tiles.append(tile)
    height = max(tile.shape[0] for tile in tiles)
    tiles = [cv2.copyMakeBorder(t, 0, height - t.shape[0], 0, 0, cv2.BORDER_CONSTANT) for t in tiles]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows))
