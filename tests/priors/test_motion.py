"""Motion of patches between two images (ops/motion)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from mmpi_priors.ops.motion import find_motion, refine_motion

pytestmark = pytest.mark.usefixtures("form")


def image(seed, shape, blur=1.5):
    noise = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), blur) if blur else noise


def moved(gray, right, down):
    shift = np.float32([[1, 0.01, right], [-0.01, 1, down]])
    return cv2.warpAffine(gray, shift, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def refined(gray, other, coarse, stride, rounds):
    arrays = (gray, other, np.float32(coarse))
    return refine_motion(*(torch.from_numpy(np.ascontiguousarray(x)) for x in arrays), stride, rounds).numpy()


HARD = {
    "moved": lambda: (image(0, (31, 44)), moved(image(0, (31, 44)), 1.3, -0.8)),
    "small": lambda: (image(0, (19, 33)), moved(image(0, (19, 33)), 1.3, -0.8)),
    "flat": lambda: (np.full((24, 30), 90, np.uint8),) * 2,
    "noise": lambda: (image(2, (24, 30), 0), image(3, (24, 30), 0)),
    "edge": lambda: (STEP, moved(STEP, 0.6, 0.4)),
}
STEP = np.repeat([[10, 240]], 24, 0).repeat(15, 1).astype(np.uint8)


@pytest.mark.parametrize("far", [0.0, 1e4])
@pytest.mark.parametrize("hard", HARD)
def test_motion_of_hard_images_is_that_of_the_definition(hard, far):
    """Where nearly equal errors decide, float32 may decide otherwise."""
    gray, other = HARD[hard]()
    coarse = torch.from_numpy(far + np.random.default_rng(1).normal(size=(7, 9, 2))).float()
    result = refine_motion(torch.from_numpy(gray), torch.from_numpy(other), coarse, 6, 6)
    expected = refine_motion.reference(torch.from_numpy(gray), torch.from_numpy(other), coarse, 6, 6)
    assert torch.isfinite(result).all()
    assert ((result - expected).abs().amax(-1) > 1e-2 * max(1, far)).float().mean() < 0.05


def test_what_is_flat_does_not_move():
    flat = torch.full((24, 30), 90, dtype=torch.uint8)
    assert (refine_motion(flat, flat, torch.zeros(1, 1, 2), 6, 4) == 0).all()


@pytest.mark.parametrize("shape", [(8, 8), (8, 50), (61, 97), (120, 90)])
def test_a_moved_image_is_followed_from_coarse_to_fine(shape):
    gray = image(4, shape, 2)
    motion = find_motion(gray, moved(gray, 2.2, -1.6), 6, 6)
    assert motion.shape == (*shape, 2) and np.isfinite(motion).all()
    if min(shape) > 60:
        inner = motion[12:-12, 12:-12]
        x, y = np.meshgrid(np.arange(12, shape[1] - 12), np.arange(12, shape[0] - 12))
        true = np.stack([2.2 + 0.01 * y, -1.6 - 0.01 * x], -1)
        assert np.median(np.abs(inner - true)) < 0.05
