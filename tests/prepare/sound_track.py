"""A drive of N cameras past points, matched without any track, and what a mapper with given poses makes of it.

The slow, plain form of a mapper's bookkeeping: each point is triangulated from the poses given, and loses the
observation that fits worst until all fit or too few are left.
"""

from __future__ import annotations

import numpy as np
import pycolmap

from mmpi_prepare.evidence import Pairs, Witness, scale_changes

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
