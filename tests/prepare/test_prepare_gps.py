"""Metres and up from the GPS of photos."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from PIL import ExifTags, Image
from test_prepare_parts import model_of

from mmpi_prepare.adjustment import camera_poses, choose_frame
from mmpi_prepare.gps import find_fit, in_metres, place_of
from mmpi_prepare.images import Photo, gather

LUND = {1: "N", 2: (55.0, 41.0, 53.4), 3: "E", 4: (13.0, 11.0, 43.4), 6: 37.0}
UNIT, TILT = 4.0, np.radians(30)
"""Metres for a unit of the models, and how far their world is tilted about the second axis."""
TILTED = np.array([[np.cos(TILT), 0, np.sin(TILT)], [0, 1, 0], [-np.sin(TILT), 0, np.cos(TILT)]])


def a_path(width, count=24, level=True):
    """Level cameras, OpenCV axes, along 80 m of a path that swings so far aside, and their true places in metres,
    east, north and up. Cameras that are not level look down."""
    along = np.linspace(-40, 40, count)
    metres = np.stack([along, width * np.sin(along / 10), 0.02 * along], -1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if level else np.diag([1.0, -1, -1])
    poses[:, :3, :3] = TILTED @ down
    poses[:, :3, 3] = metres @ TILTED.T / UNIT
    return poses, metres


def noted(metres, error=1.0, seed=0):
    """What photos near Lund note at places in metres, with errors of so many metres in each direction."""
    metres = metres + np.random.default_rng(seed).normal(0, error, metres.shape)
    places = np.array([55.7, 13.2, 40.0]) + metres[:, [1, 0, 2]] / [111_370.0, 62_900.0, 1.0]
    return list(map(tuple, places))


@pytest.mark.parametrize("level", [True, False])
def test_a_wide_path_gives_metres_and_up_whatever_the_cameras_look_at(level, capsys):
    poses, metres = a_path(40.0, level=level)
    fit = find_fit(poses, noted(metres))
    assert fit.scale == pytest.approx(UNIT, rel=0.03)
    assert np.degrees(np.arccos(fit.up @ TILTED[:, 2])) < 2
    said = capsys.readouterr().out
    assert said.startswith("Metres and up from GPS of 24 photos: they agree to 1.") and " m of 8" in said


def test_a_straight_path_gives_metres_but_no_up(capsys):
    poses, metres = a_path(1.0)
    fit = find_fit(poses, noted(metres))
    assert fit.scale == pytest.approx(UNIT, rel=0.03) and fit.up is None
    assert capsys.readouterr().out.startswith("Metres from GPS of 24 photos: they agree to 1.")
    similarity, up, unit = choose_frame(model_of(poses), None, fit)
    assert similarity.scale == fit.scale and "level" in up and unit.startswith("1 metre, from GPS of 24 photos")
    turned = similarity.rotation.matrix() @ TILTED[:, 2]
    assert turned[2] > np.cos(np.radians(1)), "by the cameras, which are level"


def test_altitudes_are_not_needed_for_metres():
    poses, metres = a_path(40.0)
    fit = find_fit(poses, [(*place[:2], float("nan")) for place in noted(metres)])
    assert fit.scale == pytest.approx(UNIT, rel=0.03) and fit.up is None


def test_places_that_are_wrong_are_left_out(capsys):
    poses, metres = a_path(40.0)
    places = noted(metres)
    places[3:9] = [(55.71, 13.21, 0.0)] * 6  # the last fix of another day
    fit = find_fit(poses, places)
    assert fit.scale == pytest.approx(UNIT, rel=0.03)
    assert "GPS of 18 of 24 photos" in capsys.readouterr().out


def test_no_metres_are_claimed_where_gps_contradicts_the_path_or_is_rare(capsys):
    poses, metres = a_path(40.0)
    assert find_fit(poses, noted(metres[np.random.default_rng(1).permutation(24)])) is None
    said = capsys.readouterr().out
    assert said.startswith("Metres are not known: GPS of 24 photos differs by")
    assert find_fit(poses, noted(0.05 * metres, 3.0)) is None, "a path of a few metres"
    assert find_fit(poses, [*noted(metres)[:11], *[None] * 13]) is None, "less than half"
    assert find_fit(poses, [noted(metres)[0]] * 24) is None and "24 photos at 1 places" in capsys.readouterr().out
    assert find_fit(poses, [None] * 24) is None and not capsys.readouterr().out


def test_places_of_exif():
    assert place_of(LUND) == pytest.approx((55 + 41 / 60 + 53.4 / 3600, 13 + 11 / 60 + 43.4 / 3600, 37.0))
    south_west = place_of(LUND | {1: "S", 3: "W", 5: b"\x01"})
    assert south_west == pytest.approx(tuple(-x for x in place_of(LUND)))
    assert np.isnan(place_of({k: v for k, v in LUND.items() if k != 6})[2])
    nothing, nan = (0.0, 0.0, 0.0), float("nan")
    for damaged in ({}, {**LUND, 2: nothing, 4: nothing}, {**LUND, 2: (nan, nan, nan)}, {**LUND, 4: "x"}, {1: "N"}):
        assert place_of(damaged) is None


def test_metres_of_degrees_at_a_latitude_and_across_the_date_line():
    places = np.array([[60.0, 179.9995, 5.0], [60.0, -179.9995, 7.0], [60.001, 180.0, 6.0]])
    metres = in_metres(places)
    assert metres[1] - metres[0] == pytest.approx([55.8, 0, 2], abs=0.1)  # 111,413 m a degree of longitude over 2
    assert metres[2, 1] - metres[0, 1] == pytest.approx(111.4, abs=0.1)


def test_photos_keep_their_places_in_a_run_that_goes_on(tmp_path):
    (tmp_path / "in").mkdir()
    exif = Image.Exif()
    exif[ExifTags.IFD.GPSInfo] = LUND
    for name, tags in (("a.jpg", exif), ("b.jpg", Image.Exif())):
        Image.new("RGB", (8, 6)).save(tmp_path / "in" / name, exif=tags)
    first, second = gather(tmp_path / "in", sorted((tmp_path / "in").iterdir()), tmp_path)
    assert first.place == pytest.approx(place_of(LUND)) and second.place is None
    again = Photo(**json.loads(json.dumps(asdict(first))))
    assert tuple(again.place) == first.place


def test_up_of_gps_is_that_of_the_scene():
    poses, metres = a_path(40.0, level=False)
    model = model_of(poses)
    similarity, up, _ = choose_frame(model, None, find_fit(poses, noted(metres, 0.1)))
    model.transform(similarity)
    _, after = camera_poses(model)
    assert up == "GPS" and np.allclose(after[:, 2, 2], -1, atol=0.01), "cameras look down"
    assert np.ptp(after[:, 0, 3]) > 70 or np.ptp(after[:, 1, 3]) > 70, "metres"
