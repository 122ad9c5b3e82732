"""Details in baked scenes: what is kept of them, where it is written, what is shown, and damage."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from baked_details import detailed_scene, details_for, opaque_window, with_details
from nerfstudio.cameras.cameras import Cameras
from random_bricks import scene_of

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.details import DetailView
from mmpi_show.details import restored_view, stored_view
from mmpi_show.files import HEADER, read_baked, write_baked

CPU = torch.device("cpu")


def bundle_of(pose):
    return image_rays(Cameras(torch.tensor(pose.to_world)[None], *pose.focal, *pose.center, *pose.size))


def test_what_is_kept_of_a_view_is_close_to_it(tmp_path):
    """Smooth differences within 3 %; depths of every fourth pixel within one of 255 codes; masks; and its camera."""
    details = details_for(scene_of(opaque_window()), tmp_path)
    for i in range(3):
        before = details.view(i, CPU)
        view = stored_view(before)
        after = restored_view(view, CPU)
        assert torch.allclose(after.camera, before.camera, rtol=1e-6) and after.image.shape == before.image.shape
        seen = before.image[..., 3] >= 0
        assert (after.image - before.image)[..., :3][seen].abs().mean() < 0.03
        kept = slice(2, -2, 4)  # the pixels whose depths are kept lie beside the centres of their blocks
        roots = [(x.image[kept, kept, 3].clamp(min=0) / view.most).sqrt() for x in (before, after)]
        apart = (roots[0] - roots[1])[seen[kept, kept]].abs()
        assert apart.median() < 0.006 and (apart < 0.03).float().mean() > 0.8  # the rest lies at edges
        assert bool((after.image[:, :14, 3] == -1).all()) == (i == 1)


def test_infinity_and_nothing_survive():
    """A view of what is infinitely far, and one that is all masked."""
    for inverse, expected in ((0.0, 0.0), (-1.0, -1.0)):
        image = torch.zeros(9, 7, 4)
        image[..., 3] = inverse
        again = restored_view(stored_view(DetailView(image, torch.arange(24.0))), CPU)
        assert bool((again.image[..., 3] == expected).all()) and again.image[..., :3].abs().max() < 1e-6


def test_what_is_written_is_read_and_shown(tmp_path):
    """At a camera of the path, details make a difference, and the file gives the image that was written."""
    scene = detailed_scene(tmp_path / "details")
    write_baked(scene, tmp_path / "baked")
    again = read_baked(tmp_path / "baked")
    assert (again.views, again.nearest) == (scene.views, 3)
    bundle = bundle_of(scene.path[0])
    images = [which.image(bundle) for which in (scene, again)]
    assert torch.allclose(images[0]["rgb"], images[1]["rgb"], atol=0.02)  # the network is kept in half precision
    field = scene.render(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))["rgb"]
    assert torch.equal(images[0]["field_rgb"].view(-1, 3), field)
    assert (images[0]["rgb"] - images[0]["field_rgb"]).abs().mean() > 0.02
    assert "field_rgb" not in replace(scene, views=()).image(bundle)


def test_details_are_of_the_radiance(tmp_path):
    """An exposure multiplies what is rendered and the details alike."""
    window = opaque_window()
    scenes = [with_details(scene_of(w), tmp_path) for w in (window, replace(window, exposure=(0.6, 0.8, 0.5)))]
    plain, exposed = (scene.image(bundle_of(scene.path[0])) for scene in scenes)
    free = (plain["accumulation"] == 1) & (plain["rgb"] > 0) & (plain["rgb"] < 1)
    expected = plain["rgb"] * torch.tensor([0.6, 0.8, 0.5])
    assert free.float().mean() > 0.3 and torch.allclose(exposed["rgb"][free], expected[free], atol=1e-5)


def test_a_window_holds_the_views_that_stand_nearest_to_it(tmp_path):
    """In the last bytes of its file, so that bricks come first."""
    scene = with_details(scene_of(opaque_window(), opaque_window(1)), tmp_path / "details")
    shifted = tuple(
        replace(view, camera=(*view.camera[:3], x, *view.camera[4:7], 0.0, *view.camera[8:11], 0.0, *view.camera[12:]))
        for view, x in zip(scene.views, (3.9, 0.2, 4.4), strict=True)
    )
    write_baked(replace(scene, views=shifted), tmp_path / "baked")
    rows = json.loads((tmp_path / "baked" / HEADER).read_text())["windows"]
    assert [[view["camera"][3] for view in row["views"]] for row in rows] == [[0.2], [3.9, 4.4]]
    for row in rows:
        starts = [view[name]["offset"] for view in row["views"] for name in ("difference", "inverse")]
        assert min(starts) == row["bricks_bytes"] > max(a["offset"] for a in row["arrays"].values())
    assert len(read_baked(tmp_path / "baked").views) == 3


def test_damaged_details_are_one_sentence(tmp_path):
    scene = detailed_scene(tmp_path / "details")
    damaged = replace(scene, views=(replace(scene.views[0], difference=b"RIFF"), *scene.views[1:]))
    with pytest.raises(ValueError, match=r"^Details of training image 0 are damaged .*: bake the scene again\.$"):
        damaged.image(bundle_of(scene.path[0]))
