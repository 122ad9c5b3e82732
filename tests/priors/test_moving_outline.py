"""Halos around something that moves leave its mask, and what is missing of it joins."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from test_moving_masks import SIZE, a_shot, neighbours, textured

from mmpi_priors.moving_evidence import least_unlike
from mmpi_priors.moving_outline import AROUND, outlined

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


def test_what_moves_in_a_neighbour_explains_nothing():
    shot, others = a_scene()
    nothing, everything = np.zeros(SIZE, bool), np.ones(SIZE, bool)
    both = least_unlike(shot, others, [nothing, nothing], EVERYWHERE)
    assert np.median(both[5:15, 20:60]) < 4 and np.median(both[26:34, 34:46]) > 12
    one = least_unlike(shot, others, [nothing, everything], EVERYWHERE)
    assert (one >= both).all() and (least_unlike(shot, others, [everything] * 2, EVERYWHERE) == 255).all()
