"""A car is followed along the path, one that leaves the image too; what stands is not, nor what one image takes for a
mover by mistake."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mmpi_ns.data.posed_images import PosedImages
from mmpi_priors import moving, moving_carry, moving_objects
from mmpi_priors.dense import Depth
from mmpi_priors.moving import reaches_side
from mmpi_priors.moving_carry import Carried, carried, whole_objects
from mmpi_priors.moving_evidence import Neighbour, Shot
from mmpi_priors.moving_objects import followed
from mmpi_priors.views import View

SIZE, FOCAL, HEIGHT = (160, 240), 200.0, 1.5
PINHOLE = np.array([FOCAL, FOCAL, 120.0, 60.0])
STEP = 1.4
"""Metres between images."""


def texture(seed: int, shape: tuple[int, int]) -> np.ndarray:
    random = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    return (128 + 800 * cv2.GaussianBlur(random, (0, 0), 4.0)).clip(0, 255).astype(np.uint8)


def ground() -> np.ndarray:
    """Inverse depth of a plane below the camera. [h, w]"""
    rows = np.arange(SIZE[0])[:, None] + 0.5
    return np.repeat(np.maximum((rows - 60) / FOCAL / HEIGHT, 0), SIZE[1], 1).astype(np.float32)


def an_image(ahead: float, boxes: list[tuple[float, float]]) -> tuple[Shot, list[np.ndarray]]:
    """A camera so far ahead on a textured ground with boxes, so far aside and from the start; where it shows them."""
    across, along = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    inverse, shown = np.maximum(ground(), 0.05), []
    places = 30 * (across - 120) / FOCAL / inverse + 400, 30 * (1 / inverse + ahead)
    gray = cv2.remap(
        texture(0, (900, 800)), *(p.astype(np.float32) for p in places), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    for seed, (aside, at) in enumerate(boxes, 1):
        far = at - ahead
        right, down = (across - 120) / FOCAL * far - aside, (along - 60) / FOCAL * far - HEIGHT
        box = (right > 0) & (right < 1.6) & (down < 0) & (down > -1.4)
        painted = cv2.remap(texture(seed, (200, 200)), *((p * 50 + 100).astype(np.float32) for p in (right, down)), 1)
        gray[box], inverse[box] = painted[box], 1 / far
        shown.append(box)
    pose = np.eye(4)[:3]
    pose[2, 3] = -ahead
    view = View(gray, PINHOLE, pose, np.ones(SIZE, bool))
    inverse = inverse.astype(np.float32)
    return Shot(view, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), Depth(inverse, 0.01 * inverse), ground()), shown


def a_path(speed: float) -> tuple[Shot, list[Neighbour], list[np.ndarray], list[list[np.ndarray]]]:
    """The last image of a path, those before it, where it shows a box that moves so fast (in speeds of the camera) and
    one that stands, and where they do. The box that moves is about to leave at the side."""
    images = [an_image(-k * STEP, [(-2.1, 3.4 - speed * k * STEP), (1.0, 6.0)]) for k in range(5)]
    (shot, shown), *before = images
    return shot, [Neighbour.of(shot, other) for other, _ in before], shown, [boxes for _, boxes in before]


@pytest.mark.parametrize("speed", [-0.8, 1.0, 1.3])
def test_a_car_that_leaves_the_image_is_followed_to_it(speed):
    """It comes towards the camera, keeps its distance, or overtakes."""
    shot, others, (car, standing), masks = a_path(speed)
    inner = carried(shot, others, [boxes[0] for boxes in masks], np.zeros(SIZE, bool)).pixels
    around = cv2.dilate(car.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert car[:, 0].any(), "the test's car does not leave"
    assert inner[car].mean() > 0.2 and not inner[~around].any() and not inner[standing].any()


def test_what_one_image_takes_for_a_mover_by_mistake_is_not_followed():
    shot, others, (_, standing), masks = a_path(1.0)
    nothing = np.zeros(SIZE, bool)
    carry = carried(shot, others, [masks[0][1], *[nothing] * 3], nothing)
    assert not (carry.pixels | carry.objects)[standing].any()


def test_nothing_is_followed_where_nothing_moves_or_there_is_no_ground():
    shot, others, _, masks = a_path(1.0)
    nothing = np.zeros(SIZE, bool)
    for carry in (
        carried(shot, others, [nothing] * 4, nothing),
        carried(replace(shot, ground=None), others, [boxes[0] for boxes in masks], nothing),
    ):
        assert not carry.pixels.any() and not carry.objects.any()


def test_a_car_without_texture_is_taken_as_a_whole():
    """Pixels that move are a third of it, scattered; the horizon is in row 30 of 80, and it reaches up to it."""
    horizon_at_30 = np.repeat(np.maximum(np.arange(80) - 29, 0)[:, None], 120, 1).astype(np.float32)
    car, curb = np.zeros((2, 80, 120), bool)
    car[32:70, 0:30], curb[58:80, 60:100] = True, True
    scattered = np.random.default_rng(0).random(car.shape) < 0.33
    nothing = np.zeros_like(car)
    whole = whole_objects(scattered & (car | curb), horizon_at_30, nothing)
    assert whole[car].mean() > 0.9 and not whole[curb].any()
    assert not whole_objects(scattered & car, horizon_at_30, car & (np.arange(120) < 17)).any()  # mostly masked already
    assert whole_objects(scattered & car, horizon_at_30, car & (np.arange(120) < 12))[car].mean() > 0.9
    assert not whole_objects(scattered & car & (np.arange(120) < 6), horizon_at_30, nothing).any()  # too small


def test_seeds_of_whole_objects_lie_inside(monkeypatch):
    """Windows reach beyond what moves."""
    shot, others, _, masks = a_path(1.0)
    box = np.zeros((SIZE[0] // 2, SIZE[1] // 2), bool)
    box[20:60, 30:90] = True
    monkeypatch.setattr(moving_carry, "whole_objects", lambda *_: box)
    objects = carried(shot, others, [boxes[0] for boxes in masks], np.zeros(SIZE, bool)).objects
    rows, columns = (np.nonzero(objects.any(axis))[0][[0, -1]].tolist() for axis in (1, 0))
    assert (rows, columns) == ([40 + 5, 119 - 5], [60 + 5, 179 - 5])


def test_images_next_to_what_is_newly_masked_at_a_side_are_looked_at_again():
    side, middle, strip = np.zeros((3, 80, 160), bool)
    side[20:60, :10], middle[20:60, 60:100], strip[20:22, -10:] = True, True, True
    assert reaches_side(side) and reaches_side(side[:, ::-1]) and not reaches_side(middle) and not reaches_side(strip)


def five_in_a_row(monkeypatch, second: list[np.ndarray], first: np.ndarray, **parts) -> list[np.ndarray]:
    """Masks of five images whose first look masks ``first``, and whose second look masks ``second``."""
    shape = first.shape
    view = View(np.zeros(shape, np.uint8), np.ones(4), np.eye(4)[:3], np.ones(shape, bool))
    shots = [Shot(view, np.zeros((*shape, 3), np.uint8), Depth(*np.zeros((2, *shape), np.float32)), None)] * 5
    poses = np.tile(np.eye(4)[:3], (5, 1, 1))
    images = PosedImages((Path("x"),) * 5, poses, np.ones((5, 4)), np.tile(shape[::-1], (5, 1)), np.zeros((5, 4)))
    unused: Any = None

    def moves(shots, near, i, masks, uprights, look):
        mask = first if look is None else second[i]
        return mask, moving._Look([np.ones(3)] * len(near), unused, unused, unused, mask)

    replaced = {
        "find_depths": lambda *_: iter(shots), "_moves": moves,
        "_outlined": lambda shots, near, masks, *_: masks,
        "neighbours": lambda images, i, keys: [j for j in (i - 1, i + 1) if 0 <= j < 5],
        "num_threads": lambda: 1,
        "is_static": lambda shot, shown: np.zeros(shape, bool), "grown": lambda shot, shown, core: core,
        "carried": lambda *_: Carried(*np.zeros((2, *shape), bool)), **parts,
    }  # fmt: skip
    for name, value in replaced.items():
        monkeypatch.setattr(moving, name, value)
    return moving.find_moving(images, lambda i: np.zeros((0, 3)))[1]


def test_an_object_at_the_side_is_followed_on_from_image_to_image_twice(monkeypatch):
    """Of five images in a row, the second look masks the first one's middle and the last one's; objects are followed
    to images whose neighbours have one at the side, not from the middle."""
    middle, speck, side = np.zeros((3, 20, 50), bool)
    middle[:, 20:30], speck[0, 20], side[:, :4] = True, True, True
    asked = []

    def carry(shot, others, masks, mask):
        asked.append(1)
        arrived = side if len(asked) == 1 or len(asked) > 5 else np.zeros_like(side)
        return Carried(np.zeros_like(side), arrived)

    masks = five_in_a_row(monkeypatch, [middle, speck, speck, speck, middle], speck, carried=carry)
    # All five along the path, of which the first has the object; then its neighbour, then that one's neighbours.
    assert [bool(mask[:, 0].all()) for mask in masks] == [True, True, True, False, False]
    assert len(asked) == 5 + 1 + 2 and masks[2][0, 20] and masks[4][0, 25]


def test_only_what_a_second_look_shows_by_itself_is_followed_by_flow_and_along_the_path(monkeypatch):
    """At once: what flow masks at the outline of a mover is not followed along the path."""
    mistake, car, by_flow = np.zeros((3, 20, 50), bool)
    mistake[:, :10], car[:, 20:30], by_flow[:, 30:34] = True, True, True
    sources = []

    def followed(shot, other, mask, flow):
        sources.append(mask)
        return by_flow

    def carry(shot, others, masks, mask):
        sources.extend([mask, *masks])
        return Carried(*np.zeros((2, 20, 50), bool))

    masks = five_in_a_row(monkeypatch, [car] * 5, mistake | car, followed=followed, carried=carry)
    assert sources and all((source == car).all() for source in sources)
    assert all((mask == car | by_flow).all() for mask in masks)


def test_people_are_followed_from_a_second_look_too_where_they_are_not_masked_yet(monkeypatch):
    """The search in what the first look shows finds nobody."""
    first, second, body, stranger = np.zeros((4, 20, 50), bool)
    first[:, 2:5], second[:, 20:30], body[:, 29:35], stranger[:, 40:45] = True, True, True, True
    searched = []

    def upright_objects(shots, near, masks, pool):
        searched.append(masks)
        return [body | stranger if len(searched) > 1 else np.zeros_like(body)] * len(shots)

    masks = five_in_a_row(monkeypatch, [second] * 5, first, upright_objects=upright_objects)
    for before, expected in zip(searched, (first, second), strict=True):
        assert all((mask == expected).all() for mask in before)
    assert all((mask == second | stranger).all() for mask in masks)


def test_outlines_are_drawn_of_all_that_was_followed(monkeypatch):
    car, by_flow = np.zeros((2, 20, 50), bool)
    car[:, 20:30], by_flow[:, 30:34] = True, True
    drawn = {"followed": lambda *_: by_flow, "_outlined": lambda shots, near, masks, *_: [~mask for mask in masks]}
    assert all((mask == ~(car | by_flow)).all() for mask in five_in_a_row(monkeypatch, [car] * 5, car, **drawn))


def test_only_images_that_were_looked_at_again_get_another_outline(monkeypatch):
    """Each against its neighbours, without what moves there."""
    masks = [np.full((2, 2), i < 4) for i in range(5)]
    unused: Any = None
    evidence: Any = SimpleNamespace(noise=2.5)
    looks = {i: moving._Look([], unused, unused, evidence, np.eye(2) > i) for i in (1, 3, 4)}
    near = [[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]]
    shots: Any = range(5)
    asked = []

    def outlined(shot, others, around, mask, core, noise):
        asked.append((shot, others, [bool(m.all()) for m in around], bool((core == (np.eye(2) > shot)).all()), noise))
        return ~mask

    monkeypatch.setattr(moving, "outlined", outlined)
    monkeypatch.setattr(moving, "_others", lambda shots, near, i, gains: near)
    with ThreadPoolExecutor(1) as pool:
        result = moving._outlined(shots, near, masks, looks, pool)
    assert [bool(mask.all()) for mask in result] == [True, False, True, False, False]
    assert asked == [(1, [0, 2], [True, True], True, 2.5), (3, [2, 4], [True, False], True, 2.5)]


def test_an_object_regrows_with_all_its_seeds_and_loses_nothing(monkeypatch):
    """One is an object for its seeds of all kinds together only; what does not regrow stays masked."""
    seed, by_flow, pixels, large = np.zeros((4, 20, 50), bool)
    seed[:, 20:22], by_flow[:, 22:24], pixels[:, 24:26], large[:, 20:30] = True, True, True, True
    cores = []

    def grown(shot, shown, core):
        cores.append(core)
        return large if core[0, 20:26].all() else np.zeros_like(core)

    def carry(*_):
        return Carried(pixels, np.zeros_like(seed))

    kinds = {"followed": lambda *_: by_flow, "carried": carry}
    masks = five_in_a_row(monkeypatch, [seed] * 5, seed, grown=grown, **kinds)
    assert len(cores) == 5 and all((mask == seed | large).all() for mask in masks)
    cores.clear()
    masks = five_in_a_row(monkeypatch, [seed] * 5, seed, grown=lambda *_: np.zeros_like(seed), **kinds)
    assert all((mask == seed).all() for mask in masks)


@pytest.mark.parametrize("turns", [False, True])
def test_what_is_followed_by_flow_is_a_pixel_inside_of_its_mask_unless_the_camera_turns(monkeypatch, turns):
    monkeypatch.setattr(moving_objects, "turned", lambda *_: turns)
    shot, _ = an_image(0.0, [])
    mask, inner = np.zeros((2, *SIZE), bool)
    mask[90:130, 60:110], inner[91:129, 61:109] = True, True
    seen = followed(shot, shot, mask, cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST))
    assert seen[inner].mean() > 0.9 and not seen[~mask].any()
    assert seen[mask & ~inner].mean() > 0.9 if turns else not seen[mask & ~inner].any()
