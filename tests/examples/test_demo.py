"""The demo's pictures on the tiny scene, and what the demo keeps, removes and says."""

from __future__ import annotations

import functools
import os
import sys
from types import SimpleNamespace

import demo as demo_script
import drawings
import figures
import film
import numpy as np
import painting
import pytest
import torch
from curve import TEST as TEST_PSNR
from curve import draw_curve, psnr_of_squared_error, read_curve
from demo import Demo, DemoError
from maps import FINER, Map, plane_depths
from PIL import Image
from sheet import GAP, LABELS, VIEW, contact_sheet, overview, show_views, spread
from tiny_scene import HEIGHT, TEST, WIDTH, image_of
from torch.utils.tensorboard import SummaryWriter
from training_runs import ready, trainer_config
from views import load_run, render_alone, render_view, truth_of

from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.scripts.command import run as run_command
from mmpi_scene import dataset


@pytest.fixture(scope="module")
def run(scene, plan_file, tmp_path_factory):
    """A run of a few steps, loaded from its folder."""
    config = trainer_config(scene, plan_file, tmp_path_factory.mktemp("run"), steps=30, training="joint")
    config.save_config()
    trainer = ready(config)
    trainer.train()
    return load_run(config.get_base_dir() / "config.yml")


@pytest.fixture(scope="module")
def shown(run):
    return show_views(run, [0, 1])


def test_light_that_passes_all_mpis_passes_each_alone(run):
    camera = run.tests.cameras[0:1]
    alone = [render_alone(run, camera, name)[..., 3] for name in run.windows.names]
    everything = run.model.get_outputs_for_camera(camera)["accumulation"][..., 0].numpy()
    assert len(alone) == 3 and min(a.max() for a in alone) > 0.1
    np.testing.assert_allclose(np.prod([1 - a for a in alone], 0), 1 - everything, atol=1e-4)
    assert run.model.show.value == "all"


def test_a_view_has_the_units_of_the_capture(run):
    view, truth = render_view(run, run.tests.cameras[0:1]), truth_of(run, 0)
    assert view.color.shape == truth.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(truth - image_of(TEST[0])).max() < 0.003
    outputs = run.model.get_outputs_for_camera(run.tests.cameras[0:1])
    np.testing.assert_allclose(view.inverse_depth, run.scale / outputs["depth"][..., 0].numpy(), rtol=1e-5)
    assert set(np.unique(view.winner)) <= {0, 1, 2}


def strip_of(sheet, row, column, header, height):
    """What the sheet shows at a row and column, as an array."""
    x, y = LABELS + column * (VIEW + GAP), header + row * (height + GAP)
    return np.asarray(sheet.crop((x, y, x + VIEW, y + height)))


def test_the_sheet_shows_truth_rendering_winner_and_each_mpi_of_every_view(run, shown):
    sheet = contact_sheet(run, shown)
    height = round(VIEW * HEIGHT / WIDTH)
    rows = 5 + len(run.windows.names)
    header = sheet.height - rows * (height + GAP) - GAP
    assert sheet.width == LABELS + 2 * (VIEW + GAP) + GAP and 80 < header < 160
    for column, view in enumerate(shown):
        wanted = [view.truth, view.view.color, None, None, np.array(run.colors)[view.view.winner]]
        wanted += [painting.over_checks(a) for a in view.alone]
        for row, picture in enumerate(wanted):
            if picture is not None:
                expected = np.asarray(painting.image_of(picture, VIEW))
                np.testing.assert_array_equal(strip_of(sheet, row, column, header, height), expected)
    assert not np.array_equal(strip_of(sheet, 5, 0, header, height), strip_of(sheet, 6, 0, header, height))


def test_psnr_of_a_view_is_that_of_its_pictures(run, shown):
    error = ((shown[0].truth.astype(np.float64) - shown[0].view.color) ** 2).mean()
    assert shown[0].psnr == pytest.approx(-10 * np.log10(error), abs=1e-4)
    assert overview(run, shown[0]).width > 2 * 400


def test_lpips_can_be_left_out_without_looking_for_its_weights(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", None)
    picture = torch.full((16, 16, 3), 0.5)
    metrics = ImageMetrics("none")
    assert set(metrics(picture, picture)) == {"psnr", "ssim", "cc_psnr"} and not metrics._lpips_tried


def test_views_are_spread_evenly():
    assert spread(32) == [5, 16, 26] and spread(3) == [0, 1, 2] and spread(1) == [0]


def test_colour_scales_rise_and_saturate():
    errors = np.array([[0.0, 0.1, painting.WORST_ERROR, 1.0]], np.float32)
    bright = painting.error_colors(errors).sum(-1)[0]
    assert bright[0] < 0.05 < bright[1] < bright[2] == bright[3]
    depths = painting.depth_colors(np.array([[0.0, 0.1, 0.5, 3.0]], np.float32), nearest=2.0).sum(-1)[0]
    assert depths[0] < depths[1] < depths[2] == depths[3]


def test_checks_show_where_an_mpi_holds_nothing():
    rgba = np.zeros((12, 12, 4), np.float32)
    rgba[:, 6:] = [1, 0, 0, 1]
    over = painting.over_checks(rgba)
    assert (over[:, 6:] == [1, 0, 0]).all() and len(np.unique(over[:, :6])) == 2


def test_the_map_has_cameras_where_they_are_and_the_mpi_between_its_borders(run):
    drawn = Map.of(run.observations, 400, 100)
    centers = run.observations.centers
    cameras = np.array(drawn.pixels(drawn.flat(centers))) / FINER
    assert ((cameras > 0) & (cameras < [400, 100])).all()
    step, down = centers[-1] - centers[0], run.observations.mean_axes[1]
    level = step - (step @ down) * down
    assert np.linalg.norm(cameras[-1] - cameras[0]) == pytest.approx(np.linalg.norm(level) * drawn.scale)
    for x, y in cameras * FINER:
        assert drawn.backdrop.getpixel((round(x), round(y))) == (20, 20, 20)
    mpi, color = run.windows.plans[0].mpis[0], (1.0, 0.0, 0.0)
    picture = np.asarray(drawn.draw([(mpi, color)]), np.float64)
    assert picture.shape == (100, 400, 3)
    forward, right = (np.asarray(row) for row in run.observations.mean_axes[[2, 0]])
    start, ahead, aside = np.array(drawn.pixels(drawn.flat(centers.mean(0) + np.stack([0 * down, forward, right]))))
    assert ahead - start == pytest.approx([drawn.scale * FINER, 0]) and aside - start == pytest.approx(
        (ahead - start)[::-1]
    )
    # Within the frustum the map is tinted, behind the MPI's origin it is not.
    row, column = np.indices((100, 400))
    flat = drawn.low + (np.stack([column, row], -1) + 0.5) / drawn.scale - drawn.flat(np.asarray([mpi.origin]))
    depth, tangent = flat[..., 0], flat[..., 1] / np.where(flat[..., 0] > 0, flat[..., 0], np.nan)
    tinted = picture[..., 0] > picture[..., 1] + 10
    inside = (depth > 1.1 * mpi.near) & (tangent > 0.9 * mpi.extent[0]) & (tangent < 0.9 * mpi.extent[1])
    outside = (depth < 0.9 * mpi.near) | (tangent < 1.1 * mpi.extent[0]) | (tangent > 1.1 * mpi.extent[1])
    cross = np.hypot(*np.moveaxis(flat, -1, 0)) * drawn.scale < 8
    assert inside.sum() > 100 and tinted[inside].mean() > 0.9 and tinted[outside & ~cross].mean() < 0.05
    disparities = 1 / np.array(plane_depths(mpi))
    assert disparities == pytest.approx((1 - np.arange(len(disparities)) / len(disparities)) / mpi.near)


def test_the_film_starts_and_ends_at_cameras_and_sways_between(run):
    cameras = run.tests.cameras
    path = film.fly_path(cameras, 9)
    assert len(path) == 9
    for place, i in ((0, 0), (8, len(cameras) - 1)):
        torch.testing.assert_close(path.camera_to_worlds[place], cameras.camera_to_worlds[i], atol=1e-5, rtol=0)
    turns = path.camera_to_worlds[:, :, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(9, 3, 3), atol=1e-5, rtol=0)
    straight = cameras.camera_to_worlds[0, :, 3].lerp(cameras.camera_to_worlds[-1, :, 3], 1 / 8)
    sway = path.camera_to_worlds[1, :, 3] - straight
    assert sway.norm() > 1e-3
    # It looks back from the side to which it swayed.
    looks, looked = (-poses[0, :, 2] for poses in (path.camera_to_worlds[1:2], cameras.camera_to_worlds))
    assert (looks - looked) @ sway < -0.05 * sway.norm()


def test_a_film_is_encoded_or_left_as_frames(run, tmp_path, monkeypatch):
    import av

    assert film.find_encoder() is not None, "PyAV comes with nerfstudio and has an encoder"
    pictures = list(film.film_frames(run, 3, nearest=1.0))
    view, high = render_view(run, film.fly_path(run.tests.cameras, 3)[1:2]), round(film.STRIP * HEIGHT / WIDTH)
    strips = [view.color, painting.depth_colors(view.inverse_depth, 1.0), np.array(run.colors)[view.winner]]
    for i, strip in enumerate(strips):
        shown = np.asarray(pictures[1].crop((0, i * high, film.STRIP, (i + 1) * high)))
        np.testing.assert_array_equal(shown[40:], np.asarray(painting.image_of(strip, film.STRIP))[40:])
    odd = [Image.new("RGB", (65, 33), (250, 0, 0))] * 5
    with av.open(str(film.write_film(odd, tmp_path))) as video:
        frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    assert len(frames) == 5 and frames[0].shape == (32, 64, 3) and frames[0][16, 32, 0] > 200
    monkeypatch.setattr(film, "find_encoder", lambda: None)
    folder = film.write_film(pictures, tmp_path)
    assert sorted(p.name for p in folder.iterdir()) == ["0000.png", "0001.png", "0002.png"]


def test_the_psnr_of_a_squared_error():
    assert psnr_of_squared_error(np.array([1.0, 0.01, 1e-4])).tolist() == pytest.approx([0, 20, 40])


def test_the_curve_joins_the_files_of_a_resumed_run(tmp_path):
    for start in (0, 20):
        writer = SummaryWriter(str(tmp_path), filename_suffix=f".{start}")
        for step in (start, start + 10):
            writer.add_scalar(TEST_PSNR, 20 + step, step, walltime=1000.0 + step)
        writer.close()
    curve = read_curve(tmp_path, TEST_PSNR)
    assert curve.tolist() == [[1000 + s, s, 20 + s] for s in (0, 10, 20, 30)]
    assert draw_curve(tmp_path, tmp_path / "psnr.png", 990.0, "") == 50
    assert Image.open(tmp_path / "psnr.png").width > 400
    with pytest.raises(ValueError, match="steps-per-eval-batch"):
        draw_curve(tmp_path / "nothing", tmp_path / "none.png", 0.0, "")


@pytest.fixture
def few_points(monkeypatch):
    """Streets with few SfM points, which are most of the work."""
    monkeypatch.setattr(dataset, "write_dataset", functools.partial(dataset.write_dataset, points=40))


@pytest.mark.usefixtures("few_points")
def test_the_street_is_made_once(tmp_path, capsys):
    demo = Demo(tmp_path, images=2)
    demo._make_scene()
    first = (tmp_path / "street" / "transforms.json").stat().st_mtime_ns
    assert len(list((tmp_path / "street" / "images").iterdir())) == 2
    demo._make_scene()
    assert (tmp_path / "street" / "transforms.json").stat().st_mtime_ns == first
    assert "kept" in capsys.readouterr().out


@pytest.mark.usefixtures("few_points")
def test_another_number_of_images_is_another_street_and_another_training(tmp_path):
    demo = Demo(tmp_path, images=3, steps=5)
    (tmp_path / "street").mkdir()
    (tmp_path / "street" / "transforms.json").write_text('{"frames": [1, 2]}')
    demo.checkpoint.parent.mkdir(parents=True)
    demo.checkpoint.touch()
    demo._make_scene()
    assert len(list((tmp_path / "street" / "images").iterdir())) == 3 and not demo.checkpoint.exists()


def test_only_a_training_of_as_many_steps_is_resumed(tmp_path):
    demo = Demo(tmp_path, steps=9)
    assert demo._resumable() is None
    demo.checkpoint.parent.mkdir(parents=True)
    for step in (3, 6):
        (demo.checkpoint.parent / f"step-{step:09d}.ckpt").touch()
    (tmp_path / "times.json").write_text('{"started": 1.0, "steps": 9}')
    assert demo._resumable() == 6
    assert Demo(tmp_path, steps=10)._resumable() is None


def test_fresh_removes_what_the_demo_wrote_and_nothing_else(tmp_path):
    (tmp_path / "runs").mkdir()
    for name in ("eval.json", "runs/log", "mine.txt"):
        (tmp_path / name).touch()
    Demo(tmp_path, fresh=True)._prepare_folder()
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_outputs_older_than_the_checkpoint_are_made_again(tmp_path):
    demo, result = Demo(tmp_path, steps=7), tmp_path / "eval.json"
    demo.checkpoint.parent.mkdir(parents=True)
    demo.checkpoint.touch()
    assert demo.checkpoint.name == "step-000000006.ckpt" and not demo._is_newer(result)
    result.touch()
    assert demo._is_newer(result)
    os.utime(result, (1, 1))
    assert not demo._is_newer(result)


def test_a_command_that_fails_or_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(DemoError, match=r"ns-train does not exist.*make venv"):
        Demo(tmp_path)._command("ns-train")
    program = tmp_path / "ns-train"
    program.write_text("#!/bin/sh\nexit 3\n")
    program.chmod(0o755)
    with pytest.raises(DemoError, match="ns-train ended with status 3"):
        Demo(tmp_path)._command("ns-train")


def test_a_full_disk_is_one_sentence_and_status_1(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo_script.shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    monkeypatch.setattr(Demo, "_make_scene", lambda _: pytest.fail("it went on"))
    monkeypatch.setattr(sys, "argv", ["demo", "--folder", str(tmp_path)])
    assert demo_script.main() == 1
    said = capsys.readouterr().err
    assert said.startswith("demo: ") and said.count("\n") == 1 and "make room" in said


def test_the_ray_of_the_figure_crosses_planes_where_geometry_says():
    mpi = drawings._front("front", 0.0)
    (found,) = drawings._distances([mpi], np.array([6.0, 0, 0]), np.array([1.0, 0, 0]))
    depths = mpi.near / (1 - np.arange(mpi.planes - 1) / (mpi.planes - 1))
    np.testing.assert_allclose(found[:-1], [d - 6 for d in depths if d > 6.5], rtol=1e-9)
    assert np.isinf(found[-1])


def test_figures_are_drawn_and_the_demo_is_asked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["figures", "--demo", str(tmp_path / "none"), "--output", str(tmp_path / "out")])
    assert run_command("figures", figures.Figures) == 1
    assert "run make demo first" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["errors.png", "merging.png", "reliability.png"]


def test_large_pictures_shrink_or_are_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), np.uint8)
    source, target = tmp_path / "large.png", tmp_path / "small.jpg"
    Image.fromarray(noise).save(source)
    figures.shrink(source, target)
    best = target.stat().st_size
    figures.shrink(source, target, best // 2)
    assert target.stat().st_size <= best // 2 and Image.open(target).size == (200, 200)
    with pytest.raises(ValueError, match="draw less"):
        figures.shrink(source, target, 1000)
    assert not target.exists()


def test_a_film_becomes_an_animated_picture_or_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    stills = [Image.fromarray(rng.integers(0, 255, (60, 96, 3), dtype=np.uint8)) for _ in range(5)]
    source, target = film.write_film(stills, tmp_path), tmp_path / "fly.webp"
    if source.is_dir():
        pytest.skip("PyAV has no encoder here")
    figures.animate(source, target, width=48)
    with Image.open(target) as picture:
        assert (picture.n_frames, picture.size) == (5, (48, 30))
    with pytest.raises(ValueError, match="film fewer frames"):
        figures.animate(source, target, most=30)
    assert not target.exists()
