"""Causes of error: who sees what, by distances, and scores of parts of an image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from causes import CAUSES, PARTS, borders, markdown, psnr_of, squared, thin, times_seen
from nerfstudio.cameras.cameras import Cameras

from mmpi_ns.data.posed_images import PosedImages

WIDTH, HEIGHT, FOCAL, WALL = 20, 10, 16.0, 4.0


def distances(ahead=WALL):
    """Of a plane so far ahead, at every pixel. [H, W]"""
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL)
    return (ahead * np.sqrt(x**2 + y**2 + 1)).astype(np.float32)


def test_a_training_image_sees_what_is_in_it_and_not_behind_something_nearer():
    poses = np.tile(np.eye(4)[:3], (3, 1, 1))
    poses[:, 0, 3] = 0.0, 1.25, 100.0  # at the test camera's place, five pixels to the right, and elsewhere
    intrinsics, sizes = np.tile([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], (3, 1)), np.tile([20.0, 10.0], (3, 1))
    posed = PosedImages(("",) * 3, poses, intrinsics, sizes, np.zeros((3, 4)), False)  # type: ignore[arg-type]
    camera = Cameras(torch.from_numpy(poses[:1]).float(), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    hidden = distances()
    hidden[:3] = distances(2.0)[:3]  # something stands in front of the first training camera
    seen = times_seen(camera, distances(), posed, [hidden, distances(), distances()])
    expected = np.zeros((HEIGHT, WIDTH), int)
    expected[3:] += 1
    expected[:, 5:] += 1  # the second one looks past the first five columns
    assert np.array_equal(seen, expected)


def test_parts_of_an_image_are_scored_by_their_own_pixels():
    error = squared(torch.full((4, 10, 3), 0.5), torch.full((4, 10, 3), 0.4))
    assert psnr_of(error) == pytest.approx(20, abs=1e-4)
    error[:, 5:] = 1e-4
    assert psnr_of(error, np.arange(10) >= np.full((4, 1), 5)) == pytest.approx(40)
    assert np.isnan(psnr_of(error, np.zeros((4, 10), bool)))
    assert np.array_equal(borders(error)[0].nonzero()[0], [0, 1, 8, 9])


@pytest.mark.parametrize(("width", "level", "found"), [(2, 60, True), (2, 30, False), (8, 60, False)])
def test_a_structure_is_thin_if_a_square_does_not_fit_into_it(width, level, found):
    image = torch.full((20, 30, 3), 0.4)
    image[:, 10 : 10 + width] += level / 255
    assert bool(thin(image)[:, 10 : 10 + width].all()) == found and not thin(image)[:, :8].any()


def test_the_page_has_a_column_for_every_capture():
    row = {
        "psnr": dict.fromkeys(CAUSES, 20.0),
        "pixels": dict.fromkeys(PARTS, 0.5),
        "error": dict.fromkeys(PARTS, 0.25),
    }
    made = dict.fromkeys(("command", "processor", "threads", "torch", "commit", "date"), "")
    text = markdown({"rows": {"one": row, "two": row}, "made": made})
    assert "| training images | 20.00 | 20.00 |" in text and "| thin structures | 50%, 25% | 50%, 25% |" in text
