"""What moves on a short drive is masked, and nothing of it gives rays or depth; what stands still is kept."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from training_runs import datamanager

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors import moving
from mmpi_priors.dense import Depth
from mmpi_priors.moving import gain_of, in_image
from mmpi_priors.moving_carry import Carried
from mmpi_priors.moving_evidence import Evidence, Neighbour, Shot, evidence, ground_of, nearest_known, splat
from mmpi_priors.moving_objects import (
    LEAST_LEVELS,
    REACH,
    STEPS,
    UNASKED,
    followed,
    grown,
    seeds,
    unexplained,
)
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


def test_what_is_static_for_sure_is_neither_swept_nor_followed_but_may_be_a_seed_or_a_person(monkeypatch):
    """One row: swept, by flow, a seed, a person, along the path, as an object: a static pixel and one that is not."""
    swept, followed_pixels, seed, person, static, pixels, objects = (np.zeros((1, 12), bool) for _ in range(7))
    swept[0, :2] = followed_pixels[0, 2:4] = seed[0, 4:6] = person[0, 6:8] = static[0, ::2] = True
    pixels[0, 8:10] = objects[0, 10:] = True
    monkeypatch.setattr(moving.Neighbour, "of", lambda *_: None)
    sweeps = moving.Sweep(swept, swept)
    for name, value in (
        ("gain_of", None), ("sweep", sweeps), ("evidence", None), ("is_static", static), ("seeds", seed),
        ("followed", followed_pixels), ("carried", Carried(pixels, objects)),
    ):  # fmt: skip
        monkeypatch.setattr(moving, name, lambda *_, value=value: value)
    monkeypatch.setattr(moving, "grown", lambda shot, shown, core: core)
    masks = [np.ones((1, 12), bool)] * 3
    nothing = Depth(*np.zeros((2, 1, 12), np.float32))
    shot = Shot(
        View(np.zeros((1, 12), np.uint8), np.ones(4), np.eye(4)[:3], static), np.zeros((1, 12, 3)), nothing, None
    )
    mask, look = moving._moves([shot] * 3, [1, 2], 0, masks, person, None)
    assert mask[0].tolist() == [False, True, *[False] * 2, *[True] * 4, *[False] * 4]
    with ThreadPoolExecutor(1) as pool:
        mask = moving._followed_on([shot] * 3, [[1, 2]] * 3, [mask, *masks[1:]], {0: look}, pool)[0]
    assert mask[0].tolist() == [*[False, True] * 2, *[True] * 4, *[False, True] * 2]


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


def test_what_moves_is_told_and_drawn(manager, tmp_path):
    dataset, path = manager.train_dataset, tmp_path / "report" / "moving.jpg"
    assert re.fullmatch(r".* % of the training pixels, in \d of 8 images, seem to move .*", manager.priors.movers)
    moving.draw_moving(path, [Path(file) for file in dataset.image_filenames], dataset.moving)
    picture = cv2.imread(str(path))
    assert picture.shape == (2 * 180, 4 * 320, 3)
    original = cv2.imread(str(dataset.image_filenames[0]))
    redder = picture[:180, :320, 2].astype(int) - original[..., 2] > 30
    mask = dataset.moving[0]
    assert redder[mask].mean() > 0.5 and redder[~mask].mean() < 0.02


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


def neighbours(shot, *others):
    return [Neighbour.of(shot, other) for other in others]


def test_a_wall_is_explained_by_its_depth_and_another_picture_is_not():
    wide = textured(0, (60, 120))
    inverse = 0.5
    shots = [a_shot(0.1 * k, np.ascontiguousarray(wide[:, 10 + round(3.5 * k) :][:, :80]), inverse) for k in (-2, 0, 2)]
    middle = np.zeros(SIZE, bool)
    middle[20:40, 30:50] = True
    assert np.median(unexplained(shots[1], neighbours(shots[1], shots[0], shots[2]), middle)) < 12
    strange = a_shot(0.0, textured(1), inverse)
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


def test_levels_are_asked_once_and_are_those_of_a_single_time():
    others = [a_shot(0.1 * k, textured(k + 5), 0.5) for k in (-2, -1, 1)]
    shot, levels = a_shot(0.0, textured(1), 0.5), np.full(SIZE, UNASKED, np.int16)
    strong, nothing = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.uint8)
    for left in (20, 60):
        strong[10:40, 10:left] = 255
        twice = seeds(shot, neighbours(shot, *others), Evidence(strong, nothing, nothing, nothing > 0, 0.0), levels)
    afresh = np.full(SIZE, UNASKED, np.int16)
    once = seeds(shot, neighbours(shot, *others), Evidence(strong, nothing, nothing, nothing > 0, 0.0), afresh)
    assert once.any() and (twice == once).all() and (levels == afresh).all()


def test_an_image_of_another_exposure_is_brought_to_that_of_the_shot():
    wide = textured(0, (60, 120))
    shot, other = (a_shot(0.1 * k, np.ascontiguousarray(wide[:, 10 + round(3.5 * k) :][:, :80]), 0.5) for k in (0, 2))
    darker = replace(other, color=np.rint(other.color * [0.5, 0.7, 0.8]).astype(np.uint8))
    np.testing.assert_allclose(gain_of(shot, darker), [2, 1 / 0.7, 1.25], rtol=0.05)
    np.testing.assert_allclose(Neighbour.of(shot, darker, gain_of(shot, darker)).color, other.color, atol=12)


def test_what_two_neighbours_would_not_show_is_not_judged():
    shots = [a_shot(5.0 * k, textured(k), 0.5) for k in range(3)]
    corner = np.zeros(SIZE, bool)
    corner[:5, :5] = True
    assert not unexplained(shots[0], neighbours(*shots), corner).any()


def test_depths_of_another_camera_land_where_they_project():
    far, near = a_shot(0.0, textured(0), 0.1), a_shot(0.4, textured(0), 0.1)
    near.depth.inverse[10:20, 30:50] = 0.5
    seen = splat(far, near)
    shift = round(70 * 0.4 * 0.5)
    np.testing.assert_allclose(seen[12:18, 32 + shift : 48 + shift], 0.5, rtol=1e-5)


@pytest.mark.parametrize("side", [0, 1])
def test_depths_that_land_on_the_very_border_of_an_image_stay_in_it(side):
    """A pixel is inside by its product with the depth, and its quotient may be rounded to what lies beyond."""
    far, ahead = a_shot(0.0, textured(0), 0.0), a_shot(0.0, textured(0), 0.0)
    pose = ahead.view.pose.copy()
    pose[2, 3] = 1.0  # behind the other camera
    depth, random = ahead.depth.inverse, np.random.default_rng(0)
    place, extent, middle = (np.mgrid[: SIZE[0], : SIZE[1]] + 0.5)[side], SIZE[side], SIZE[side] // 2
    behind = replace(ahead, view=replace(ahead.view, pose=pose))
    for _ in range(300):  # q at which a pixel lands on the border: middle + (place - middle) / (1 - q) = extent
        depth[:] = (extent - place) / (extent - middle) * (1 + random.uniform(-4e-7, 4e-7, SIZE))
        assert splat(far, behind).shape == SIZE


def test_the_ground_is_found_and_a_wall_is_not_ground():
    rows = np.arange(SIZE[0])[:, None] + 0.5
    ground = np.repeat(np.maximum((rows - 30) / 70 / 1.5, 0), SIZE[1], 1).astype(np.float32)
    up = np.array([0.0, 1.0, 0.0])
    found = ground_of(a_view(), Depth(ground, 0.01 * ground), up)
    assert found is not None
    np.testing.assert_allclose(found[40:], ground[40:], rtol=1e-3)
    wall = np.full(SIZE, 0.2, np.float32)
    assert ground_of(a_view(), Depth(wall, 0.01 * wall), up) is None


@pytest.mark.parametrize("rows", [120, 100, 95])
def test_a_square_is_followed_to_where_it_moved_also_between_images_of_two_sizes(rows):
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    background = cv2.cvtColor(textured(2, (120, 160), 3.0), cv2.COLOR_BGR2GRAY)
    square, mask, at = (
        cv2.cvtColor(textured(3, SIZE, 3.0), cv2.COLOR_BGR2GRAY)[:40, :40],
        np.zeros((120, 160), bool),
        [],
    )
    for x in (60, 63):
        gray = background.copy()
        gray[40:80, x : x + 40] = square
        color = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        nowhere = Depth(*np.zeros((2, 120, 160), np.float32))
        at.append(Shot(View(gray, PINHOLE, np.eye(4)[:3], np.ones((120, 160), bool)), color, nowhere, None))
    mask[40:80, 63:103] = True
    view = at[1].view
    lower = replace(at[1], view=View(view.gray[:rows], PINHOLE, view.pose, view.inside[:rows]))
    seen = followed(at[0], lower, mask[:rows], flow)
    assert followed(lower, at[0], mask, flow).shape == (rows, 160)
    truth = np.zeros_like(mask)
    truth[40:80, 60:100] = True
    assert seen[truth].mean() > 0.7 and seen[~truth].mean() < 0.01


def test_what_moves_along_is_followed_to_an_image_that_is_turned():
    """By 13 degrees: the whole picture shifts by 57 pixels, more than optical flow finds."""
    c, s = np.cos(np.radians(13.0)), np.sin(np.radians(13.0))
    pinhole, full = np.array([250.0, 250.0, 80.0, 60.0]), np.ones((120, 160), bool)
    ahead = cv2.cvtColor(textured(4, (120, 160), 3.0), cv2.COLOR_BGR2GRAY)
    pose = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0.0]])
    to_ahead = (
        camera_matrix(pinhole) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ np.linalg.inv(camera_matrix(pinhole))
    )
    mask = np.zeros((120, 160), np.uint8)
    mask[40:80, 20:50] = 1
    turned, moves = (
        cv2.warpPerspective(image, to_ahead, (160, 120), flags=cv2.WARP_INVERSE_MAP) for image in (ahead, mask)
    )
    nowhere = Depth(*np.zeros((2, 120, 160), np.float32))
    shots = [
        Shot(View(np.asarray(gray, np.uint8), pinhole, at, full), np.zeros((120, 160, 3), np.uint8), nowhere, None)
        for gray, at in ((ahead, np.eye(4)[:3]), (turned, pose))
    ]
    assert moves.any() and np.abs(np.argwhere(moves).mean(0)[1] - np.argwhere(mask).mean(0)[1]) > 50
    seen = followed(*shots, moves > 0, cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST))
    assert seen[mask > 0].mean() > 0.7 and seen[mask == 0].mean() < 0.01


def a_scene(color, horizon=None, judged=None):
    nothing = np.zeros(SIZE, np.uint8)
    judged = np.ones(SIZE, bool) if judged is None else judged
    row = None if horizon is None else np.full(SIZE[1], float(horizon))
    shot = Shot(a_view(), color, Depth(*np.zeros((2, *SIZE), np.float32)), None, row)
    return shot, Evidence(nothing, nothing, nothing, judged, 0.0)


@pytest.mark.parametrize(("width", "reaches"), [(10, True), (30, False)], ids=["person", "car"])
def test_a_narrow_thing_reaches_the_horizon_also_in_the_colours_behind_it(width, reaches):
    color = np.random.default_rng(0).integers(80, 100, (*SIZE, 3)).astype(np.uint8)
    core = np.zeros(SIZE, bool)
    core[23:55, 30 : 30 + width] = True
    color[core] += 100
    mask = grown(*a_scene(color, horizon=14), core)
    assert mask[24:54, 31 : 29 + width].all()
    assert mask[14:19, 31 : 29 + width].mean() == reaches


@pytest.mark.parametrize(("left", "filled"), [(16, False), (4, True)], ids=["somebody's shadow", "a car"])
def test_what_is_above_a_shadow_beside_the_feet_of_somebody_is_not_filled(left, filled):
    """Seeds on a body and, left of it, in the lowest rows."""
    color = np.random.default_rng(0).integers(80, 100, (*SIZE, 3)).astype(np.uint8)
    core = np.zeros(SIZE, bool)
    core[23:55, 30:40] = core[51:55, left:30] = True
    color[23:55, 30:40] += 100
    color[51:55, left:30] -= 70
    mask = grown(*a_scene(color, horizon=14), core)
    assert mask[24:54, 31:39].all() and mask[52:54, left:30].all()
    assert mask[26:44, left + 2 : 28].mean() == filled


@pytest.mark.parametrize(("apart", "kept"), [(6, True), (13, False)])
def test_an_object_that_seeds_hardly_cover_is_none(apart, kept):
    core = np.zeros(SIZE, bool)
    core[4:57:apart, 20:30] = True
    assert grown(*a_scene(np.full((*SIZE, 3), 200, np.uint8)), core).any() == kept


@pytest.mark.parametrize(("row", "moves"), [(20, True), (40, False), (None, True)])
def test_what_hangs_above_the_height_of_the_camera_is_none(row, moves):
    """A branch before the sky, or a car; nothing is left out by it where the camera looks steeply down."""
    core = np.zeros(SIZE, bool)
    core[15:38, 20:40] = True
    color = np.full((*SIZE, 3), 60, np.uint8)
    color[core] = 200
    shot, shown = a_scene(color)
    level = None if row is None else np.full(SIZE[1], float(row))
    assert grown(replace(shot, level=level), shown, core).any() == moves


@pytest.mark.parametrize("silent", [True, False], ids=["nothing is said", "all is judged"])
def test_an_object_reaches_on_to_the_border_where_neighbours_say_nothing(silent):
    """A car of one colour that leaves at the left and below; seeds lie on its right end."""
    color = np.full((*SIZE, 3), 60, np.uint8)
    color[30:, :50] = 200
    core, judged = np.zeros(SIZE, bool), np.ones(SIZE, bool)
    core[32:52, 34:50] = True
    judged[:, :33] = judged[53:] = not silent
    mask = grown(*a_scene(color, 25, judged), core)
    assert mask[32:52, 34:50].all() and not mask[:, 56:].any()
    assert mask[34:56, 4:28].mean() == (1 if silent else 0)


@pytest.mark.parametrize(("degrees", "silent"), [(2.0, False), (4.0, True)])
def test_neighbours_are_silent_only_about_images_between_which_the_camera_turned(degrees, silent):
    """All show pictures of their own, so that no two agree."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    shot, *others = (a_shot(0.1 * k, textured(k), 0.5) for k in range(3))
    others[1].view.pose[:, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    judged = evidence(shot, neighbours(shot, *others), [None, None], np.zeros(SIZE, bool)).judged
    assert judged.mean() < 0.5 if silent else judged.all()


def test_seeds_count_half_where_neighbours_say_nothing():
    core = np.zeros(SIZE, bool)
    core[4:57:13, 20:30] = True
    judged = np.ones(SIZE, bool)
    judged[4:57, 20:30] = False
    assert grown(*a_scene(np.full((*SIZE, 3), 200, np.uint8), judged=judged), core).any()


def test_unknown_pixels_take_the_depth_of_the_nearest_known():
    inverse = np.zeros((5, 9), np.float32)
    inverse[2, 1], inverse[2, 7] = 0.25, 0.5
    found = nearest_known(inverse)
    assert found[2, 2] == 0.25 and found[0, 8] == 0.5


def test_a_mask_of_a_straightened_view_lies_where_the_lens_shows_it():
    distortion = np.array([[-0.2, 0.0, 0.0, 0.0]])
    images = PosedImages((), np.eye(4)[None, :3], 2 * PINHOLE[None], np.array([[160.0, 120.0]]), distortion)
    mask = np.zeros(SIZE, bool)
    mask[8:14, 66:72] = True
    shown = in_image(a_view(), mask, images, 0, (120, 160))
    y, x = np.argwhere(shown).mean(0) + 0.5
    corner = np.array([[[(69 - 40) / 70, (11 - 30) / 70]]])
    bent = cv2.projectPoints(
        np.dstack([corner, np.ones((1, 1))]), *np.zeros((2, 3)), camera_matrix(2 * PINHOLE), distortion[0]
    )
    np.testing.assert_allclose([x, y], bent[0].ravel(), atol=1.0)
