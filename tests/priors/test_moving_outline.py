"""Halos around something that moves leave its mask, and what is missing of it joins."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_moving_masks import SIZE, a_shot, neighbours, textured

from mmpi_priors.moving_evidence import least_unlike
from mmpi_priors.moving_objects import touching
from mmpi_priors.moving_outline import AROUND, OVER, outlined

EVERYWHERE = np.s_[0 : SIZE[0], 0 : SIZE[1]]
SQUARE, HALO = np.s_[22:38, 30:50], np.s_[16:44, 24:56]


def in_box(box) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[box] = True
    return mask


def a_scene():
    """A wall with another picture in front of it in the middle image; its neighbours, in which nothing moves."""
    wide = textured(0, (60, 120))
    shots = [a_shot(0.1 * k, np.ascontiguousarray(wide[:, 10 + round(3.5 * k) :][:, :80]), 0.5) for k in (-2, 0, 2)]
    shots[1].color[SQUARE] = textured(1)[SQUARE]
    return shots[1], neighbours(shots[1], shots[0], shots[2])


def outline(mask, core, hidden=False, level=None):
    shot, others = a_scene()
    level = None if level is None else np.full(SIZE[1], float(level))
    return outlined(replace(shot, level=level), others, [np.full(SIZE, hidden)] * 2, mask, core, 2.0)


def test_what_a_neighbour_explains_leaves_from_outside():
    shown = outline(in_box(HALO), in_box(np.s_[30:34, 38:42]))
    around = cv2.dilate(in_box(SQUARE).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert shown[SQUARE].mean() > 0.95 and not shown[~around].any()


def test_what_no_neighbour_explains_joins():
    shown = outline(in_box(np.s_[22:38, 30:41]), in_box(np.s_[30:34, 34:38]))
    around = cv2.dilate(in_box(SQUARE).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert shown[SQUARE].mean() > 0.95 and not shown[~around].any()


def test_another_thing_that_nothing_explains_does_not_join():
    shot, others = a_scene()
    for box in (np.s_[47:55, 32:48], np.s_[26:34, 50:78]):  # one beside it, one that it touches
        shot.color[box] = textured(2)[box]
    mask, core = in_box(SQUARE), in_box(np.s_[30:34, 38:42])
    shown = outlined(shot, others, [np.zeros(SIZE, bool)] * 2, mask, core, 2.0)
    assert not shown[48:].any() and shown[26:34, 50:56].mean() > 0.8 and not shown[:, 50 + AROUND + 2 :].any()


def test_what_is_explained_amid_something_that_moves_stays():
    shot, others = a_scene()
    hole = np.s_[25:35, 33:44]
    shot.color[hole] = a_shot(0.0, np.ascontiguousarray(textured(0, (60, 120))[:, 10:90]), 0.5).color[hole]
    mask, core = in_box(HALO), in_box(np.s_[30:34, 46:49])
    assert outlined(shot, others, [np.zeros(SIZE, bool)] * 2, mask, core, 2.0)[hole].all()


def test_what_lies_below_the_ground_explains_nothing():
    shot, others = a_scene()
    still = [np.zeros(SIZE, bool)] * 2
    above = least_unlike(replace(shot, ground=np.full(SIZE, 2.0, np.float32)), others, still, EVERYWHERE)
    assert np.median(above[5:15, 30:50]) > np.median(least_unlike(shot, others, still, EVERYWHERE)[5:15, 30:50]) + 8


def test_only_a_pixel_joins_where_neighbours_show_nothing_but_what_moves():
    halo = in_box(HALO)
    wider = cv2.dilate(halo.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0
    np.testing.assert_array_equal(outline(halo, in_box(np.s_[30:34, 38:42]), hidden=True), wider)


def test_nothing_leaves_above_the_horizon():
    shown = outline(in_box(HALO), in_box(np.s_[30:34, 38:42]), level=30)
    assert shown[16:30, 24:56].all() and not shown[40:44].any()


def test_nothing_leaves_just_above_seeds():
    shown = outline(in_box(HALO), in_box(np.s_[22:26, 36:44]))
    assert shown[22 - OVER + 2 : 22, 37:43].all() and not shown[16:20, 24:32].any()


@pytest.mark.parametrize("box", [np.s_[2:12, 60:75], np.s_[50:58, 5:15]])
def test_objects_without_seeds_stay(box):
    person = in_box(box)
    shown = outline(in_box(HALO) | person, in_box(np.s_[30:34, 38:42]))
    assert shown[box].all()


def test_what_moves_in_a_neighbour_explains_nothing():
    shot, others = a_scene()
    nothing, everything = np.zeros(SIZE, bool), np.ones(SIZE, bool)
    both = least_unlike(shot, others, [nothing, nothing], EVERYWHERE)
    assert np.median(both[5:15, 20:60]) < 4 and np.median(both[26:34, 34:46]) > 12
    one = least_unlike(shot, others, [nothing, everything], EVERYWHERE)
    assert (one >= both).all() and (least_unlike(shot, others, [everything] * 2, EVERYWHERE) == 255).all()


@pytest.mark.parametrize("box", [HALO, np.s_[0:9, 0:7], np.s_[51:60, 70:80]])
def test_a_box_says_the_same_as_the_whole_image(box):
    """But at its border, where windows reach beyond it, unless the image ends there, too."""
    shot, others = a_scene()
    shot = replace(shot, ground=np.full(SIZE, 0.1, np.float32))
    moves = [in_box(np.s_[10:30, 10:30]), in_box(np.s_[20:50, 40:44])]
    whole, part = (least_unlike(shot, others, moves, each) for each in (EVERYWHERE, box))
    inner = tuple(
        slice(s.start + 3 * (s.start > 0), s.stop - 3 * (s.stop < size)) for s, size in zip(box, SIZE, strict=True)
    )
    np.testing.assert_array_equal(part[inner], whole[inner])
    assert (part[~in_box(box)] == 255).all()


def test_parts_without_seeds_do_not_touch_any():
    two = in_box(np.s_[5:9, 5:9]) | in_box(np.s_[20:30, 20:30])
    np.testing.assert_array_equal(touching(two, in_box(np.s_[8:12, 8:12])), in_box(np.s_[5:9, 5:9]))
    assert not touching(two, np.zeros(SIZE, bool)).any()
