"""Verdicts on tracks that are right, and on ones that were broken on purpose: drives of N cameras past points, matched
without any track, and what a mapper with given poses makes of them.

The slow, plain form of a mapper's bookkeeping: each point is triangulated from the poses given, and loses the
observation that fits worst until all fit or too few are left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from mmpi_prepare.evidence import (
    Pairs,
    Witness,
    agreement,
    bridges,
    held_by_side,
    scale_changes,
    strides,
    turns_explain,
)
from mmpi_prepare.verdict import judge_alone, judge_together, remedy

FOCAL, WIDTH, HEIGHT = 360.0, 620, 188
LIMIT = 3.0
"""Pixels that an observation may be off."""
OVERLAP = 6


def drive(count=24, turn=0.02, step=0.9):
    """Camera to world, OpenCV axes: a drive that bends. [N, 4, 4]"""
    poses, place = [], np.zeros(3)
    for i in range(count):
        c, s = np.cos(turn * i), np.sin(turn * i)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        pose[:3, 3] = place
        poses.append(pose)
        place = place + step * pose[:3, 2]
    return np.array(poses)


def scattered(poses, number=900, seed=0):
    """Points beside and above the way. [P, 3]"""
    random = np.random.default_rng(seed)
    along = random.integers(0, len(poses), number)
    side = random.choice([-1, 1], number) * random.uniform(2, 9, number)
    local = np.stack([side, random.uniform(-3, 1.5, number), random.uniform(4, 22, number)], -1)
    return np.einsum("pij,pj->pi", poses[along, :3, :3], local) + poses[along, :3, 3]


def project(poses, points, focal=FOCAL):
    """Pixels [N, P, 2] and whether they are seen [N, P]."""
    local = np.einsum("nji,npj->npi", poses[:, :3, :3], points[None] - poses[:, None, :3, 3])
    depth = np.maximum(local[..., 2], 1e-6)
    pixels = focal * local[..., :2] / depth[..., None] + [WIDTH / 2, HEIGHT / 2]
    inside = (local[..., 2] > 1) & (local[..., 2] < 40) & (pixels > 0).all(-1) & (pixels < [WIDTH, HEIGHT]).all(-1)
    return pixels, inside


def triangulated(rays, centers):
    """The point nearest to all rays. [3]"""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]


def witness_with(poses, pixels, seen, focal=FOCAL, name="incremental"):
    """What a mapper with these poses and this focal length would say of the keypoints.

    Args:
        poses: camera to world as the mapper has them. [N, 4, 4]
        pixels: keypoints. [N, P, 2]
        seen: which there are. [N, P]
    """
    count = len(poses)
    kept = np.zeros_like(seen)
    local = np.concatenate([(pixels - [WIDTH / 2, HEIGHT / 2]) / focal, np.ones((*pixels.shape[:2], 1))], -1)
    rays = np.einsum("nij,npj->npi", poses[:, :3, :3], local)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for p in range(pixels.shape[1]):
        views = np.flatnonzero(seen[:, p])
        while len(views) >= 2:
            point = triangulated(rays[views, p], poses[views, :3, 3])
            there = np.einsum("nji,nj->ni", poses[views, :3, :3], point - poses[views, :3, 3])
            off = np.linalg.norm(focal * (there[:, :2] / there[:, 2:] - local[views, p, :2]), axis=-1)
            off = np.where(there[:, 2] > 0, off, np.inf)
            if off.max() < LIMIT:
                kept[views, p] = True
                break
            views = np.delete(views, off.argmax())
    rows = []
    for i in range(count):
        for j in range(i + 1, min(count, i + OVERLAP + 1)):
            both = np.flatnonzero(seen[i] & seen[j])
            turn = poses[j, :3, :3].T @ poses[i, :3, :3]
            x, y, z = poses[j, :3, :3].T @ (poses[i, :3, 3] - poses[j, :3, 3])
            essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
            squared = pycolmap.compute_squared_sampson_error(local[i, both, :2], local[j, both, :2], essential)
            off = np.sqrt(squared) * focal
            fitting, beside = (off < 1.24).sum(), ((off >= 1.24) & (off < 4 * 1.24)).sum()
            rows.append((i, j, len(both), (kept[i, both] & kept[j, both]).sum(), fitting, beside))
    table = np.array(rows)
    pairs = Pairs(table[:, 0], table[:, 1], *table[:, 2:].T.astype(float))
    names = [f"frame_{i:03d}" for i in range(count)]
    scales = scale_changes(*observed(poses, pixels, kept, focal), count)
    return Witness(name, names, np.arange(count), poses, pairs, focal / WIDTH, scales, "", pycolmap.Reconstruction())


def observed(poses, pixels, seen, focal=FOCAL):
    """Point, frame, centre and ray of every keypoint that is seen."""
    frames, points = np.nonzero(seen)
    local = np.concatenate([(pixels - [WIDTH / 2, HEIGHT / 2]) / focal, np.ones((*pixels.shape[:2], 1))], -1)
    rays = np.einsum("oij,oj->oi", poses[frames, :3, :3], local[frames, points])
    return points, frames, poses[frames, :3, 3], rays / np.linalg.norm(rays, axis=-1, keepdims=True)


POSES = drive()
POINTS = scattered(POSES)


@pytest.fixture(scope="module")
def keypoints():
    pixels, seen = project(POSES, POINTS)
    return pixels + np.random.default_rng(1).normal(0, 0.3, pixels.shape), seen


@pytest.fixture(scope="module")
def sound(keypoints):
    return witness_with(POSES, *keypoints)


def moved(frames, shift=(0.0, 0.0, 0.0), scale=1.0, about=0):
    """The drive with some frames moved, and scaled about one of them."""
    poses = POSES.copy()
    origin = poses[about, :3, 3]
    poses[frames, :3, 3] = origin + scale * (poses[frames, :3, 3] - origin) + shift
    return poses


def test_sound_track_is_right(sound):
    verdict = judge_alone(sound, is_sequence=True)
    assert verdict.grade == "right" and not verdict.summary
    assert judge_alone(sound, is_sequence=False).grade == "right"


def test_jump_along_the_way_is_broken_though_epipolar_lines_do_not_see_it(keypoints):
    """Driving straight ahead, a leap forward leaves all epipolar lines where they were."""
    straight = drive(turn=0.0)
    pixels, seen = project(straight, scattered(straight))
    broken = straight.copy()
    broken[12:, 2, 3] += 6 * 0.9
    witness = witness_with(broken, pixels, seen)
    assert bridges(witness.pairs, len(straight), witness.pairs.fitting).min() > 0.99
    verdict = judge_alone(witness, is_sequence=True)
    assert verdict.grade == "broken"
    assert "between frame_011 and frame_012" in verdict.summary and "usual steps" in verdict.summary


def test_a_break_before_the_last_image_is_doubtful_and_believed_where_two_mappers_agree(sound):
    pairs = sound.pairs
    tracked = np.where(pairs.second == 23, 0.1 * pairs.matches, pairs.tracked)
    witness = replace(sound, pairs=replace(pairs, tracked=tracked))
    verdict = judge_alone(witness, is_sequence=True)
    assert verdict.grade == "doubtful" and "between frame_022 and frame_023" in verdict.summary
    assert judge_together(replace(witness, name="global"), [sound], True).grade == "right"
    inside = np.where((pairs.first < 12) & (pairs.second >= 12), 0.15 * pairs.matches, tracked)
    verdict = judge_alone(replace(sound, pairs=replace(pairs, tracked=inside)), is_sequence=True)
    assert verdict.grade == "broken" and "between frame_011 and frame_012" in verdict.summary


def test_scale_that_breaks_half_way_is_not_right(keypoints):
    verdict = judge_alone(witness_with(moved(np.s_[12:], scale=0.3, about=11), *keypoints), is_sequence=True)
    assert verdict.grade != "right" and "frame_01" in verdict.summary


def test_collapsed_track_is_broken(keypoints):
    """All cameras on one spot, but for noise: their rays meet nowhere."""
    poses = POSES.copy()
    poses[:, :3, 3] = np.random.default_rng(3).normal(0, 1e-3, (len(poses), 3))
    verdict = judge_alone(witness_with(poses, *keypoints), is_sequence=True)
    assert verdict.grade == "broken"


def test_wrong_focal_length_in_a_bend_is_not_right(keypoints):
    assert judge_alone(witness_with(POSES, *keypoints, focal=1.5 * FOCAL), is_sequence=True).grade != "right"


def test_one_misplaced_image_of_an_unordered_set_is_named(keypoints):
    poses = moved([7], shift=(3.0, -1.0, 2.0))
    verdict = judge_alone(witness_with(poses, *keypoints), is_sequence=False)
    assert verdict.grade != "right" and "frame_007" in verdict.summary


def test_gap_in_the_capture_is_no_break(keypoints):
    """Frames that are missing make a long step, over which the matches hold."""
    pixels, seen = keypoints
    kept = np.r_[0:10, 13:24]
    witness = witness_with(POSES[kept], pixels[kept], seen[kept])
    assert strides(witness)[0].max() > 2
    assert judge_alone(witness, is_sequence=True).grade == "right"
    assert strides(replace(witness, places=kept))[0].max() < 1.5


def test_two_mappers_of_one_mind_are_right_and_of_two_minds_doubtful(sound, keypoints):
    turned = np.diag([2.0, 2, 2, 1]) @ np.array([[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1.0]])
    other = POSES.copy()
    other[:, :3, :3] = turned[:3, :3] @ POSES[:, :3, :3] / 2
    other[:, :3, 3] = POSES[:, :3, 3] @ turned[:3, :3].T + turned[:3, 3]
    difference = agreement(sound, replace(sound, poses=other))
    assert difference is not None and difference.centers.max() < 1e-9 and difference.turns.max() < 1e-4
    assert judge_together(sound, [replace(sound, poses=other)], True).grade == "right"
    bent = replace(sound, poses=drive(turn=0.03), name="global", focal=0.7)
    verdict = judge_together(sound, [bent], True)
    assert verdict.grade == "doubtful" and "0.58 and 0.70 image sides" in verdict.summary


def test_the_chosen_track_is_compared_as_it_was_before_it_alone_was_adjusted(sound):
    """Adjusting bends it a little; and what may help depends on the capture."""
    adjusted = replace(sound, poses=drive(turn=0.03), name="global")
    assert judge_together(adjusted, [sound], True).grade == "doubtful"
    assert judge_together(adjusted, [sound], True, before=replace(sound, name="global")).grade == "right"
    assert "--focal" in remedy(1, True, False) and "frames before" in remedy(1, True, False)
    assert "--focal" not in remedy(10, False, False) and "frames" not in remedy(10, False, False)
    assert remedy(1, False, True).startswith("Add images that overlap more")


def test_a_track_from_another_focal_length_that_is_as_good_speaks_against_the_chosen_one(sound):
    rival = replace(sound, poses=drive(turn=0.03))
    assert judge_together(sound, [rival], True).grade == "doubtful"
    ally = replace(sound, name="global")
    assert judge_together(sound, [ally, rival], True).grade == "doubtful"
    worse = replace(rival, pairs=replace(rival.pairs, fitting=0.97 * rival.pairs.fitting))
    assert judge_alone(worse, True).grade == "right"
    assert judge_together(sound, [worse], True).grade == "doubtful"
    assert judge_together(sound, [ally, worse], True).grade == "right"  # fewer matches fit it, and two are against it


def test_what_is_doubtful_is_not_believed_because_the_same_mapper_says_it_twice(sound):
    weak = replace(sound, pairs=replace(sound.pairs, tracked=0.5 * sound.pairs.tracked))
    assert judge_alone(weak, True).grade == "doubtful"
    assert judge_together(weak, [weak], True).grade == "doubtful"
    assert judge_together(weak, [replace(weak, name="global")], True).grade == "right"


def test_scale_that_changes_is_measured_where_it_changes(keypoints):
    """Against points found one by one from the frames before and after each gap, of noisy keypoints."""
    poses = moved(np.s_[12:], scale=1.5, about=11)
    points, frames, centers, rays = observed(poses, *keypoints)
    shuffled = np.random.default_rng(5).permutation(len(points))
    actual = scale_changes(points[shuffled], frames[shuffled], centers[shuffled], rays[shuffled], len(poses))
    for gap in (4, 11, 13):
        ratios = []
        for p in np.unique(points):
            own = points == p
            sides = [np.flatnonzero(own & side) for side in (frames <= gap, frames > gap)]
            if min(map(len, sides)) < 2:
                continue
            if max(rays[s[0]] @ rays[s[-1]] for s in sides) > np.cos(np.radians(1)):
                continue
            near = sides[0][-1]
            at = [(triangulated(rays[s], centers[s]) - centers[near]) @ rays[near] for s in sides]
            ratios += [np.log(at[1] / at[0])] if min(at) > 0 else []
        middle = np.median(ratios)
        error = 1.48 * np.median(np.abs(ratios - middle)) / np.sqrt(len(ratios))
        assert len(ratios) > 20 and actual[gap] == pytest.approx(np.sign(middle) * max(abs(middle) - 3 * error, 0))
    assert np.nanargmax(np.abs(actual)) == 11 and np.exp(actual[11]) == pytest.approx(1.5, abs=0.05)
    still = scale_changes(*observed(POSES, *keypoints), len(POSES))
    assert np.nanmax(np.abs(still)) < 0.01


def test_one_misplaced_image_of_a_sequence_is_named_though_most_matches_across_its_gaps_hold(keypoints):
    """The images before and after it see each other."""
    sideways = drive()
    sideways[12, :3, 3] += 3.0 * sideways[12, :3, 0]
    witness = witness_with(sideways, *keypoints)
    held = held_by_side(witness.pairs, len(sideways))
    assert np.nanmin(held) == min(held[0, 12], held[1, 12]) < 0.4
    verdict = judge_alone(witness, is_sequence=True)
    assert verdict.grade != "right" and "frame_012 is misplaced" in verdict.summary


def test_false_matches_far_from_their_lines_bend_nothing_and_those_beside_them_do(sound):
    pairs = sound.pairs
    across = (pairs.first < 12) & (pairs.second >= 12)
    fitting = np.where(across, 0.6 * pairs.matches, pairs.fitting)
    false = replace(sound, pairs=replace(pairs, fitting=fitting, beside=np.where(across, 0.0, pairs.beside)))
    assert judge_alone(false, is_sequence=True).grade == "right"
    bent = replace(sound, pairs=replace(pairs, fitting=fitting, beside=np.where(across, 0.4 * pairs.matches, 0.0)))
    verdict = judge_alone(bent, is_sequence=True)
    assert verdict.grade == "doubtful" and "bent between frame_011 and frame_012: 60%" in verdict.summary


def pairs_of_rays(shift, zoom=1.0, count=6):
    """Matches of cameras that turn about y and move sideways by ``shift`` from one to the next, and their bound."""
    g = np.random.default_rng(0)
    points = np.c_[g.uniform(-2, 2, (200, 2)), g.uniform(3, 9, 200)]
    rays = []
    for i in range(count):
        angle = 0.03 * i
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        x, y, z = ((points - [shift * i, 0, 0]) @ turn).T
        rays.append(zoom * np.c_[x / z, y / z] + g.normal(0, 2e-4, (200, 2)))
    pairs = [(rays[i], rays[j]) for i in range(count) for j in range(i + 1, count)]
    return pairs, [2e-3] * len(pairs)


@pytest.mark.parametrize("zoom", [0.6, 1.0, 1.7])
def test_a_camera_that_turns_in_one_place_is_told_from_one_that_moves(zoom):
    assert turns_explain(*pairs_of_rays(0.0, zoom))
    assert not turns_explain(*pairs_of_rays(0.1, zoom))
    assert not turns_explain([], [])


def test_a_pixel_without_a_ray_leaves_its_pair_and_a_pair_without_rays_the_others():
    camera = pycolmap.Camera.create(1, pycolmap.CameraModelId.SIMPLE_RADIAL, 1000.0, 800, 1200)
    camera.params = [1000.0, 400.0, 600.0, -0.3]
    assert np.isnan(camera.cam_from_img(np.array([[10.0, 10.0]]))).all()
    for shift in (0.0, 0.1):
        pairs, fits = pairs_of_rays(shift)
        pairs[0][1][3], pairs[4] = np.nan, (np.full((200, 2), np.nan), pairs[4][1])
        assert turns_explain(pairs, fits) == (shift == 0.0)
    assert not turns_explain([(np.full((200, 2), np.nan),) * 2], [2e-3])


def test_without_parallax_a_track_is_doubtful_though_mappers_agree(sound):
    turning = replace(sound, only_turns=True)
    verdict = judge_together(turning, [replace(turning, name="global")], True)
    assert not sound.only_turns and verdict.grade == "doubtful" and "turns in one place" in verdict.summary
