"""The page in a real browser: its canvas against our renderer, its controls, its console, and its refusals."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from baked_details import detailed_scene
from browser import CHROMIUM, browser, served
from random_bricks import random_window, scene_of

import mmpi_ns
import mmpi_show
from mmpi_ns.scene.windows import window_shares
from mmpi_ns.viewer import CapturedPath
from mmpi_show.files import HEADER, read_baked, write_baked
from mmpi_show.reader import camera_rays, take_borders
from mmpi_show.web import write_page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the page with (apt-get install chromium)")
CLOSE = 48.0
"""dB between the canvas and our renderer: a canvas holds 8 bits, and a card interpolates codes with 8 bits too."""


WHOLE = "[...mmpi.windows.values()].every((w) => w && w.whole)"
"""All of the windows at hand has come, not the first part alone."""


def smooth_window(seed, **settings):
    """A window whose codes change at the borders of bricks alone, for a card interpolates with 8 bits."""
    window = random_window(seed=seed, density=(120, 200), **settings)
    for table in (window.mpis.density, window.mpis.texels):
        table[:] = table[:, :1, :1]
        take_borders(table.numpy(), window.mpis.neighbours())
    return window


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    write_baked(scene_of(smooth_window(1, num_mpis=3, planes=40), smooth_window(2), radius=1.9), folder)
    write_page(folder)
    return folder


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@pytest.fixture(scope="module")
def opened(tab, site):
    with served(site) as address:
        assert tab.open(f"{address}/index.html") == "ready", tab.evaluate("document.body.innerText")
        tab.until(WHOLE)
        yield tab


def psnr(a, b):
    return -10 * np.log10(np.square(a - b).mean())


def ours(site, pose):
    scene = read_baked(site)
    origins, directions = camera_rays(pose.__dict__)
    screenshot = scene.render(*(torch.tensor(np.array(x), dtype=torch.float32) for x in (origins, directions)))
    return screenshot["rgb"].view(pose.size[1], pose.size[0], 3).numpy()


def screenshot(tab, number):
    return tab.picture(f"(mmpi.draw(mmpi.path[{number}], ...mmpi.path[{number}].size), mmpi.gl.canvas.toDataURL())")


def test_the_canvas_shows_what_we_render(opened, site):
    for number, pose in enumerate(read_baked(site).path):
        a, b = screenshot(opened, number), ours(site, pose)
        assert b.std() > 0.02  # there is something to see
        assert psnr(a, b) > CLOSE, (number, psnr(a, b))


def until(happened, wait=30):
    """Waits for what an event brings about: the page handles it when it comes to it."""
    end = time.monotonic() + wait
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def eye(tab):
    return np.array(tab.evaluate("mmpi.camera.eye"))


def axes(tab):
    return np.array(tab.evaluate("mmpi.camera.axes"))


def test_controls_move_the_camera(opened):
    """Keys, wheel, dragging, and the captured path; each frame is drawn."""
    opened.evaluate("mmpi.press('r')")
    before, back = eye(opened), axes(opened)[2]
    opened.key("keyDown", "w")
    until(lambda: np.linalg.norm(eye(opened) - before) > 0)
    opened.key("keyUp", "w")
    opened.until("mmpi.keys.size === 0")
    walked = eye(opened) - before
    assert walked @ back < 0 and np.linalg.norm(walked - (walked @ back) * back) < 1e-6
    stopped = eye(opened)
    opened.mouse("mouseWheel", 100, 80, deltaX=0, deltaY=100)
    until(lambda: (eye(opened) - stopped) @ back > 0)
    opened.mouse("mousePressed", 100, 80, button="left", clickCount=1)
    opened.mouse("mouseMoved", 140, 80, button="left")
    until(lambda: 0.5 < axes(opened)[2] @ back < 0.9999)
    aside = axes(opened)
    opened.mouse("mouseMoved", 140, 90, button="left")
    opened.mouse("mouseReleased", 140, 90, button="left", clickCount=1)
    until(lambda: 0.5 < axes(opened)[2] @ aside[2] < 0.9999)
    # One looks to where one drags, as in nerfstudio's viewer.
    assert np.cross(back, aside[2]) @ opened.evaluate("mmpi.header.up") < 0 < axes(opened)[2] @ aside[1]
    before_turn, width = axes(opened)[2], opened.evaluate("innerWidth")
    opened.evaluate("(window.innerWidth = innerHeight / 4, mmpi.turn(9, 0))")  # a narrow window, which the height fills
    pixel = opened.evaluate("mmpi.camera.focal[0] * innerHeight / mmpi.camera.size[1]")
    assert np.arccos(axes(opened)[2] @ before_turn) == pytest.approx(9 / pixel, rel=0.1)
    opened.evaluate(f"window.innerWidth = {width}")
    opened.evaluate("mmpi.press('p')")
    opened.until("mmpi.playing === null")
    assert np.allclose(eye(opened), opened.evaluate("mmpi.path[1].eye"))
    opened.evaluate("mmpi.press('r')")
    assert np.allclose(eye(opened), before)
    ends = opened.evaluate("[mmpi.path[0].eye, mmpi.path.at(-1).eye]")
    for place in (1, 0):
        opened.evaluate(f"$('place').value = {place} * $('place').max; $('place').dispatchEvent(new Event('input'))")
        assert np.allclose(eye(opened), ends[-place])
    opened.evaluate("mmpi.camera.eye = mmpi.camera.eye.map((x) => x + 1e-3); $('nearest').click()")
    assert np.allclose(eye(opened), ends[0])
    opened.evaluate("$('play').click()")
    opened.until("mmpi.playing === null && !$('play').checked")
    assert np.allclose(eye(opened), ends[1])


def test_keys_choose_what_is_shown(opened):
    """Depth, winning MPI and one MPI alone differ from the colours, and colours come back."""
    colors = screenshot(opened, 1)
    pictures = []
    for key in ("2", "3"):
        opened.evaluate(f"mmpi.press('{key}')")
        pictures.append(screenshot(opened, 1))
    opened.evaluate("mmpi.press('1')")
    alone = []
    for _ in range(3):
        opened.evaluate("mmpi.press('m')")
        assert "alone" in opened.evaluate("document.getElementById('status').textContent")
        alone.append(screenshot(opened, 1))
    pictures.append(max(alone, key=lambda p: np.abs(p - colors).mean()))  # one may be all that is seen
    assert all(np.abs(p - colors).mean() > 0.01 for p in pictures)
    opened.evaluate("mmpi.press('m')")
    assert opened.evaluate("mmpi.alone") is None
    assert np.array_equal(screenshot(opened, 1), colors)


def test_the_console_stays_empty(opened):
    assert opened.messages == []


NEEDED_LAST = """(() => {
    const at = (eye) => windowShares(mmpi.header.windows, eye), { eye, axes } = mmpi.camera;
    const ahead = at(add(eye, axes[2], -mmpi.speed)), needed = at(eye).map((s, w) => s > 0 || ahead[w] > 0);
    const kept = [...mmpi.windows.keys()], count = needed.filter(Boolean).length;
    return kept.slice(kept.length - count).every((w) => needed[w]);
})()"""
"""Whether the windows that the camera needs would be freed last."""


def at_its_place(window, x):
    """The window with its MPIs so far along, and a camera that looks into the first of them."""
    mpis = tuple(
        replace(m, origin=(x, 0.1 * k, 0.0), name=f"{m.name} at {x:g}") for k, m in enumerate(window.mpis.mpis)
    )
    moved = replace(window, mpis=replace(window.mpis, mpis=mpis, packed={}))
    return moved, scene_of(moved).path[0]


def test_a_long_capture_keeps_few_windows(tab, tmp_path):
    """Windows are fetched as the camera comes, let go behind it, and fetched again; all the way they are shown as by
    us, and mixed where two meet. Those that were needed last stay; key M names MPIs of the window one is in."""
    places = [4.0 * i + 1.9 * (i % 2) for i in range(8)]  # the middle of each ball of radius 1.9, or its border
    windows, path = zip(*(at_its_place(smooth_window(10 + i, planes=24), x) for i, x in enumerate(places)), strict=True)
    scene = replace(scene_of(*windows, radius=1.9), path=list(path))
    write_baked(scene, tmp_path)
    write_page(tmp_path)
    difference = lambda number: np.square(screenshot(tab, number) - ours(tmp_path, path[number])).mean()  # noqa: E731
    with served(tmp_path) as address:
        assert tab.open(f"{address}/index.html") == "ready"
        assert tab.evaluate("mmpi.start") == CapturedPath(np.stack([view.to_world for view in path])).start
        assert tab.evaluate("mmpi.windows.size") <= 3  # the two that meet at the first camera, and the nearest one
        tab.evaluate("mmpi.camera = structuredClone(mmpi.path[0]); mmpi.touched(); mmpi.feed()")
        tab.until("mmpi.windows.get(0)?.whole")
        tab.evaluate("window.first = mmpi.windows.get(0).textures")
        for number in [0, 1, 2, 1, *range(2, len(windows)), 0]:
            tab.evaluate(f"mmpi.camera = structuredClone(mmpi.path[{number}]); mmpi.touched(); mmpi.feed()")
            assert tab.evaluate("mmpi.alone") is None, "another window's MPI was shown alone"
            assert tab.evaluate(NEEDED_LAST)
            shares = window_shares(torch.tensor(path[number].to_world)[None, :, 3], tuple(w for w, _ in scene.windows))
            for w in shares[0].nonzero()[:, 0].tolist():
                tab.until(f"mmpi.windows.get({w})?.whole")
            assert tab.evaluate("mmpi.windows.size") <= 4
            assert ours(tmp_path, path[number]).std() > 0.01 and -10 * np.log10(difference(number)) > CLOSE - 4
            tab.evaluate("mmpi.press('m')")
            named = windows[int(shares[0].argmax())].mpis.mpis[0].name
            assert tab.evaluate("document.getElementById('status').textContent") == f"MPI '{named}' alone"
            if number == len(windows) - 1:
                assert not tab.evaluate("window.first.some((t) => mmpi.gl.isTexture(t)) || mmpi.windows.has(0)")
    assert tab.messages == []


@pytest.fixture(scope="module")
def detailed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("detailed")
    write_baked(detailed_scene(folder / "details"), folder / "site")
    write_page(folder / "site")
    return folder / "site"


def detailed_image(site, number):
    scene = mmpi_show.load(site, device="cpu")
    size = scene.path.sizes[number].tolist()
    return mmpi_ns.render(scene, scene.path.camera_to_worlds[number], scene.path.intrinsics[number], *size).rgb.numpy()


def test_details_are_those_of_baked_scenes(tab, detailed):
    """Of a pinhole, a camera with a lens, masked in part, and a fisheye; one MPI alone has none."""
    with served(detailed) as address:
        assert tab.open(f"{address}/index.html") == "ready"
        for number in (0, 1):
            tab.evaluate(f"mmpi.camera = structuredClone(mmpi.path[{number}]); mmpi.touched(); mmpi.feed()")
            loaded = "mmpi.details.views.filter((view) => mmpi.details.layers.includes(view)).length === 3"
            tab.until(f"{WHOLE} && {loaded}")
            a, b, field = (
                screenshot(tab, number),
                detailed_image(detailed, number),
                ours(detailed, read_baked(detailed).path[number]),
            )
            assert psnr(a, b) > CLOSE and psnr(field, b) < 28, (number, psnr(a, b), psnr(field, b))
        tab.evaluate("mmpi.press('m')")
        assert psnr(screenshot(tab, 0), ours(detailed, read_baked(detailed).path[0])) > CLOSE  # the only MPI alone
        tab.evaluate("mmpi.press('m')")
    assert tab.messages == []


def test_damaged_details_are_a_sentence_on_the_page(tab, detailed, tmp_path):
    shutil.copytree(detailed, tmp_path / "site")
    header = json.loads((tmp_path / "site" / HEADER).read_text())
    blob = tmp_path / "site" / header["windows"][0]["file"]
    data = bytearray(blob.read_bytes())
    for view in header["windows"][0]["views"]:
        data[view["difference"]["offset"] : view["difference"]["offset"] + 12] = bytes(12)
    blob.write_bytes(data)
    with served(tmp_path / "site") as address:
        tab.open(f"{address}/index.html")
        tab.until("document.body.dataset.state === 'failed'")
        assert "damaged" in tab.evaluate("document.getElementById('status').textContent")


def test_one_file_opens_from_the_disk(tab, site, tmp_path):
    write_page(site, tmp_path / "one.html")
    assert tab.open((tmp_path / "one.html").as_uri()) == "ready"
    tab.until(WHOLE)
    assert screenshot(tab, 0).std() > 0.02


def refusal(tab, address):
    assert tab.open(address) == "failed"
    text = tab.evaluate("document.getElementById('status').textContent")
    assert text.endswith(".") and "Error" not in text, text
    return text


def test_damage_is_a_sentence_on_the_page(tab, tmp_path):
    write_baked(scene_of(smooth_window(3)), tmp_path)
    write_page(tmp_path)
    blob, header = tmp_path / "window-00000.bin", tmp_path / HEADER
    whole, text = blob.read_bytes(), header.read_text()
    with served(tmp_path) as address:
        page = f"{address}/index.html"
        blob.write_bytes(whole[:-5])
        assert "cut short" in refusal(tab, page)
        blob.write_bytes(whole[:200] + bytes(60) + whole[260:])
        assert "damaged" in refusal(tab, page)
        blob.write_bytes(whole)
        header.write_text(json.dumps(json.loads(text) | {"version": 7}))
        assert "version 7" in refusal(tab, page)
        header.write_text("{")
        assert "damaged" in refusal(tab, page)
        header.unlink()
        assert "missing" in refusal(tab, page)
    header.write_text(text)
    assert "--single-file" in refusal(tab, (tmp_path / "index.html").as_uri())
