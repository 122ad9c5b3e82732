"""What moves on a short drive is masked, and nothing of it gives rays or depth; what stands still is kept. Halos around
what moves leave its mask, and what is missing of it joins."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from training_runs import datamanager

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors.dense import Depth
from mmpi_priors.moving import gain_of, in_image
from mmpi_priors.moving_evidence import Neighbour, Shot, ground_of, least_unlike
from mmpi_priors.moving_objects import LEAST_LEVELS, REACH, STEPS, unexplained
from mmpi_priors.moving_outline import AROUND, outlined
from mmpi_priors.views import Parallax, View, camera_matrix
from mmpi_scene.catalogue import make_scene
from mmpi_scene.dataset import write_dataset
from mmpi_scene.movers import MOVER, with_movers

SIZE = (60, 80)
PINHOLE = np.array([70.0, 70.0, 40.0, 30.0])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A street with a car that keeps its distance and an oncoming one."""
    folder = tmp_path_factory.mktemp("drive")
    write_dataset(with_movers(make_scene("street", 0, 16, 320, 180, 13.0), 2), folder, 800)
    return folder


@pytest.fixture(scope="module")
def manager(drive):
    return datamanager(drive)


def test_most_of_the_cars_is_masked_and_little_else(drive, manager):
    moving, static = [], []
    for i, file in enumerate(manager.train_dataset.image_filenames):
        truth = cv2.imread(str(drive / "moving" / file.name), cv2.IMREAD_UNCHANGED)
        mask = ~manager.train_dataset.get_data(i, image_type="uint8")["mask"][..., 0].numpy()
        moving.append(mask[truth == MOVER])
        static.append(mask[truth == 0])
    assert np.concatenate(moving).mean() > 0.75
    assert np.concatenate(static).mean() < 0.02


def test_masked_pixels_have_no_depth_and_draw_no_ray(manager):
    masked = [~manager.train_dataset.get_data(i, image_type="uint8")["mask"][..., 0].numpy() for i in range(8)]
    assert sum(mask.sum() for mask in masked) > 1000
    for i, mask in enumerate(masked):
        assert not manager.priors.depths.image(i)[mask].any()
    for step in range(20):
        image, row, column = manager.next_train(step)[1]["indices"].T.tolist()
        assert not any(masked[i][r, c] for i, r, c in zip(image, row, column, strict=True))


def test_masks_of_the_user_win_and_the_option_leaves_all_pixels(drive, manager):
    assert manager.train_dataset.has_masks and not manager.eval_dataset.has_masks
    kept = datamanager(drive, mask_moving=False)
    assert not kept.train_dataset.has_masks
    assert kept.priors.depths.share > manager.priors.depths.share


def a_view(shift=0.0, gray=None) -> View:
    """From a camera that stands so far to the right, facing -z."""
    pose = np.eye(4)[:3]
    pose[0, 3] = shift
    return View(np.zeros(SIZE, np.uint8) if gray is None else gray, PINHOLE, pose, np.ones(SIZE, bool))


def a_shot(shift, color, inverse) -> Shot:
    full = np.full(SIZE, inverse, np.float32)
    return Shot(a_view(shift), color, Depth(full, 0.01 * full), None)


def textured(seed, shape=SIZE, grain=1.5):
    random = np.random.default_rng(seed).uniform(-1, 1, (*shape, 3)).astype(np.float32)
    return np.clip(128 + 200 * grain * cv2.GaussianBlur(random, (0, 0), grain), 0, 255).astype(np.uint8)


def of_wall(shift) -> Shot:
    """Of a textured wall at inverse depth 0.5."""
    return a_shot(shift, np.ascontiguousarray(textured(0, (60, 120))[:, 10 + round(35 * shift) :][:, :80]), 0.5)


def neighbours(shot, *others):
    return [Neighbour.of(shot, other) for other in others]


def test_a_wall_is_explained_by_its_depth_and_another_picture_is_not():
    shots = [of_wall(0.1 * k) for k in (-2, 0, 2)]
    middle = np.zeros(SIZE, bool)
    middle[20:40, 30:50] = True
    assert np.median(unexplained(shots[1], neighbours(shots[1], shots[0], shots[2]), middle)) < 12
    strange = a_shot(0.0, textured(1), 0.5)
    assert np.median(unexplained(strange, neighbours(strange, shots[0], shots[2]), middle)) > 20


def least_levels(shot, others, row, column, steps):
    """Of one pixel, in float64, depth by depth and neighbour by neighbour."""
    color, best = shot.color[row, column].astype(int), 255
    for q in steps:
        levels = []
        for other in others:
            parallax = Parallax.between(shot.view, other.view)
            at = parallax.linear @ [column + 0.5, row + 0.5, 1] + q * parallax.b
            x, y = (int(np.floor(c / at[2])) for c in at[:2])
            if not (0 <= x < SIZE[1] and 0 <= y < SIZE[0]):
                continue
            window = other.color[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].reshape(-1, 3).astype(int)
            levels.append(np.maximum(window.min(0) - color, color - window.max(0)).max().clip(0, 254))
        if len(levels) < 2:
            return 0
        best = min(best, sorted(levels)[1])
    return best


def test_levels_are_those_of_every_depth_or_fewer_than_a_seed_needs():
    others = [a_shot(0.5 * k, textured(k + 5), 0.5) for k in (-2, -1, 1)]
    shot = a_shot(0.0, textured(1), 0.5)
    candidates = np.zeros(SIZE, bool)
    candidates[5::11, ::9] = True
    levels = unexplained(shot, neighbours(shot, *others), candidates)
    steps = np.linspace(0, REACH * 0.5, STEPS)
    slow = np.array([least_levels(shot, others, *at, steps) for at in np.argwhere(candidates)])
    few = slow <= LEAST_LEVELS
    assert 0.2 < few.mean() < 0.8
    assert (levels[few] <= LEAST_LEVELS).mean() > 0.95 and (levels[~few] == slow[~few]).mean() > 0.95


def test_an_image_of_another_exposure_is_brought_to_that_of_the_shot():
    shot, other = of_wall(0.0), of_wall(0.2)
    darker = replace(other, color=np.rint(other.color * [0.5, 0.7, 0.8]).astype(np.uint8))
    np.testing.assert_allclose(gain_of(shot, darker), [2, 1 / 0.7, 1.25], rtol=0.05)
    np.testing.assert_allclose(Neighbour.of(shot, darker, gain_of(shot, darker)).color, other.color, atol=12)


def test_the_ground_is_found_and_a_wall_is_not_ground():
    rows = np.arange(SIZE[0])[:, None] + 0.5
    ground = np.repeat(np.maximum((rows - 30) / 70 / 1.5, 0), SIZE[1], 1).astype(np.float32)
    up = np.array([0.0, 1.0, 0.0])
    actual = ground_of(a_view(), Depth(ground, 0.01 * ground), up)
    assert actual is not None
    np.testing.assert_allclose(actual[40:], ground[40:], rtol=1e-3)
    wall = np.full(SIZE, 0.2, np.float32)
    assert ground_of(a_view(), Depth(wall, 0.01 * wall), up) is None


def test_a_mask_of_a_straightened_view_lies_where_the_lens_shows_it():
    distortion = np.array([[-0.2, 0.0, 0.0, 0.0]])
    images = PosedImages((), np.eye(4)[None, :3], 2 * PINHOLE[None], np.array([[160.0, 120.0]]), distortion)
    mask = np.zeros(SIZE, bool)
    mask[8:14, 66:72] = True
    visible = in_image(a_view(), mask, images, 0, (120, 160))
    y, x = np.argwhere(visible).mean(0) + 0.5
    corner = np.array([[[(69 - 40) / 70, (11 - 30) / 70]]])
    bent = cv2.projectPoints(
        np.dstack([corner, np.ones((1, 1))]), *np.zeros((2, 3)), camera_matrix(2 * PINHOLE), distortion[0]
    )
    np.testing.assert_allclose([x, y], bent[0].ravel(), atol=1.0)


# Outlines -------------------------------------------------------------------------------------------------------------

EVERYWHERE = np.s_[0 : SIZE[0], 0 : SIZE[1]]
SQUARE, HALO = np.s_[22:38, 30:50], np.s_[16:44, 24:56]


def in_box(box) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[box] = True
    return mask


def a_scene():
    """A wall with another picture in front of it in the middle image; its neighbours, in which nothing moves."""
    before, shot, after = (of_wall(0.1 * k) for k in (-2, 0, 2))
    shot.color[SQUARE] = textured(1)[SQUARE]
    return shot, neighbours(shot, before, after)


def outline(mask, core):
    shot, others = a_scene()
    return outlined(shot, others, [np.zeros(SIZE, bool)] * 2, mask, core, 2.0)


def test_what_a_neighbour_explains_leaves_from_outside():
    visible = outline(in_box(HALO), in_box(np.s_[30:34, 38:42]))
    around = cv2.dilate(in_box(SQUARE).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert visible[SQUARE].mean() > 0.95 and not visible[~around].any()


def test_what_no_neighbour_explains_joins():
    visible = outline(in_box(np.s_[22:38, 30:41]), in_box(np.s_[30:34, 34:38]))
    around = cv2.dilate(in_box(SQUARE).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert visible[SQUARE].mean() > 0.95 and not visible[~around].any()


def test_another_thing_that_nothing_explains_does_not_join():
    shot, others = a_scene()
    for box in (np.s_[47:55, 32:48], np.s_[26:34, 50:78]):  # one beside it, one that it touches
        shot.color[box] = textured(2)[box]
    mask, core = in_box(SQUARE), in_box(np.s_[30:34, 38:42])
    visible = outlined(shot, others, [np.zeros(SIZE, bool)] * 2, mask, core, 2.0)
    assert not visible[48:].any() and visible[26:34, 50:56].mean() > 0.8 and not visible[:, 50 + AROUND + 2 :].any()


def test_what_moves_in_a_neighbour_explains_nothing():
    shot, others = a_scene()
    nothing, everything = np.zeros(SIZE, bool), np.ones(SIZE, bool)
    both = least_unlike(shot, others, [nothing, nothing], EVERYWHERE)
    assert np.median(both[5:15, 20:60]) < 4 and np.median(both[26:34, 34:46]) > 12
    one = least_unlike(shot, others, [nothing, everything], EVERYWHERE)
    assert (one >= both).all() and (least_unlike(shot, others, [everything] * 2, EVERYWHERE) == 255).all()
