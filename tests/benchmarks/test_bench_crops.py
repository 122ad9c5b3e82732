"""Crops of test images beside the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from crops import BORDER, TEXT, Crops
from PIL import Image

from mmpi_ns.utils.errors import InputError


def rendered(folder: Path, gray: int) -> Path:
    """A test image of 60 x 40 as ns-eval writes it: the truth, whose right half is 200, and a gray rendering."""
    folder.mkdir(parents=True)
    both = np.full((40, 120, 3), gray, np.uint8)
    both[:, :60] = np.where(np.arange(60) < 30, 50, 200)[None, :, None]
    Image.fromarray(both).save(folder / "eval_img_0003.png")
    return folder


def test_a_row_shows_the_truth_and_each_run_enlarged(tmp_path):
    folders = rendered(tmp_path / "before" / "eval", 90), rendered(tmp_path / "now" / "eval", 130)
    crops = ((3, 0, 0, 20, 10), (3, 40, 30, 20, 10))
    Crops(images=folders, crops=crops, output=tmp_path / "out" / "crops.png", side=40).main()
    sheet = np.asarray(Image.open(tmp_path / "out" / "crops.png"))
    step, height = 40 + BORDER, 20 + TEXT + BORDER
    assert sheet.shape == (2 * height, 3 * step, 3)
    for row, truth in enumerate((50, 200)):
        shown = sheet[row * height + TEXT :][:20]
        for column, gray in enumerate((truth, 90, 130)):
            assert (shown[:, column * step :][:, :40] == gray).all()


@pytest.mark.parametrize(
    ("crop", "names", "message"),
    [
        ((4, 0, 0, 20, 10), (), "eval_img_0004.png is missing"),
        ((3, 41, 0, 20, 10), (), "reaches out of 60 x 40"),
        ((3, 0, -1, 20, 10), (), "reaches out of 60 x 40"),
        ((3, 0, 0, 0, 10), (), "reaches out of 60 x 40"),
        ((3, 0, 0, 20, 10), ("one", "too many"), "one name for each folder"),
    ],
)
def test_what_cannot_be_shown_is_said(tmp_path, crop, names, message):
    folder = rendered(tmp_path / "run" / "eval", 90)
    with pytest.raises(InputError, match=message):
        Crops(images=(folder,), names=names, crops=(crop,), output=tmp_path / "crops.png").main()
    assert not (tmp_path / "crops.png").exists()
