"""Baked scenes on disk: what is written is read, by both readers, and damage is one sentence."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from random_bricks import random_window, rays_into, scene_of

from mmpi_show.details import StoredView
from mmpi_show.files import HEADER, read_baked, write_baked


@pytest.fixture
def folder(tmp_path):
    write_baked(scene_of(random_window(), random_window(num_mpis=3, seed=5)), tmp_path / "baked")
    return tmp_path / "baked"


def test_what_is_written_is_read(folder):
    """Bit for bit, but for the network, which is kept in half precision."""
    scene = scene_of(random_window(), random_window(num_mpis=3, seed=5))
    again = read_baked(folder)
    assert (again.name, again.up, again.path) == (scene.name, scene.up, scene.path)
    for (place, window), (other_place, other) in zip(scene.windows, again.windows, strict=True):
        assert (place.center, place.radius, place.margin) == (
            other_place.center,
            other_place.radius,
            other_place.margin,
        )
        for name in ("columns", "density", "texels"):
            assert torch.equal(getattr(window.mpis, name), getattr(other.mpis, name)), name
        for name in ("mpis", "intervals", "density_codes", "channel_codes"):
            assert getattr(window.mpis, name) == getattr(other.mpis, name), name
        assert (window.threshold, window.ray_near, window.farthest) == (other.threshold, other.ray_near, other.farthest)
        for layer, other_layer in zip(window.shader.layers, other.shader.layers, strict=True):
            for a, b in zip(layer, other_layer, strict=True):
                assert torch.equal(a.half().float(), b)


def test_windows_are_mixed_by_their_shares():
    """Midway between two windows a ray shows the mean of both, and inside a ball one alone."""
    a, b = random_window(seed=3, stored=1.0), random_window(seed=4, stored=1.0)
    scene = scene_of(a, b, radius=1.5)  # centres 4 apart, margins of 1: shares of a half in the middle
    _, directions, _, _ = rays_into(a, 12)
    origins = torch.tensor([2.0, 0.0, 0.0]).expand(12, 3).contiguous()
    rendered = scene.render(origins, directions)["rgb"]
    parts = [w.render(origins, directions)["rgb"] for w in (a, b)]
    torch.testing.assert_close(rendered, (parts[0] + parts[1]) / 2, atol=1e-5, rtol=0)
    at_first = scene.render(origins - 2, directions)["rgb"]
    torch.testing.assert_close(at_first, a.render(origins - 2, directions)["rgb"])
    beyond = origins + torch.tensor([2.0, 0.0, 0.0])  # winners are counted through all windows, as Scene.mpis
    winners = scene.render(beyond, directions)["winning_mpi"] - len(a.mpis.mpis)
    assert torch.equal(winners, b.render(beyond, directions)["winning_mpi"])


def edit(folder, **changes):
    header = json.loads((folder / HEADER).read_text())
    (folder / HEADER).write_text(json.dumps(header | changes))


def test_damage_is_one_sentence(folder):
    """Each says what is wrong and what to do; a file is never half read."""

    def refused(*words):
        with pytest.raises(ValueError) as caught:
            read_baked(folder)
        assert "\n" not in str(caught.value) and all(w in str(caught.value) for w in words), str(caught.value)

    blob = folder / "window-00001.bin"
    whole = blob.read_bytes()
    blob.write_bytes(whole[:-7])
    refused("window-00001.bin", "cut short", "copy it anew")
    damaged = bytearray(whole)
    damaged[200:260] = bytes(60)
    blob.write_bytes(damaged)
    refused("window-00001.bin", "damaged")
    blob.unlink()
    refused("missing")
    blob.write_bytes(whole)
    edit(folder, version=3)
    refused("version 3", "reads version 5")
    edit(folder, version=5, windows=[{"file": "window-00001.bin", "bytes": len(whole)}])
    refused("damaged", "bake the scene again")
    edit(folder, format="something")
    refused("not the header")
    (folder / HEADER).write_text("{")
    refused("damaged")
    (folder / HEADER).unlink()
    refused("no baked scene", "mmpi-export bake")


def test_what_comes_first_takes_a_tenth_of_the_bytes(tmp_path):
    """The bricks that are seen most, whatever the bricks, and whatever comes behind them."""
    window = random_window(seed=2, planes=200)
    bricks, g = window.mpis.num_bricks, torch.Generator().manual_seed(0)
    window = replace(window, seen=torch.rand(bricks, generator=g))
    window.mpis.texels[: bricks // 2] = 7
    scene, counts = scene_of(window), []
    view = StoredView((0.0,) * 24, (8, 8), 1.0, bytes(9), bytes(40_000))
    for views in ((), (view,)):
        write_baked(replace(scene, views=views, nearest=len(views)), tmp_path)
        row, early = json.loads((tmp_path / HEADER).read_text())["windows"][0], read_baked(tmp_path).windows[0][1].seen
        assert 0.09 < row["first_bytes"] / row["bytes"] <= 0.1
        assert window.seen[early > 0].min() > window.seen[early == 0].max()
        counts.append(int(early.sum()))
    assert counts[0] < counts[1] < bricks / 2
