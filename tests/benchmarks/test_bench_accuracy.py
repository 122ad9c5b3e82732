"""The accuracy benchmark: its solids against a march along the ray, its orders against errors of known order."""

from __future__ import annotations

import json

import accuracy
import numpy as np
import pytest
from solids import Solids


def test_rays_enter_the_solids_where_a_fine_march_first_finds_itself_inside():
    origins, directions = (x[::29] for x in accuracy.cameras())
    found = accuracy.SLANTED.hit(origins, directions)
    steps = np.arange(0, 12, 1e-3)
    points = origins[:, None] + steps[:, None] * directions[:, None]
    marched = steps[(accuracy.SLANTED.depth_inside(points) >= 0).argmax(-1)]
    assert np.abs(found - marched).max() < 1.1e-3
    wall = Solids(accuracy.SLANTED.normal, accuracy.SLANTED.offset).hit(origins, directions)
    assert 0.1 < (found < wall - 1e-6).mean() < 0.5, "some rays meet the ball, more of them the wall"


def test_errors_fall_in_the_first_order_with_planes_and_the_second_with_texels(monkeypatch):
    monkeypatch.setattr(accuracy, "PLANES", (17, 33, 65))
    monkeypatch.setattr(accuracy, "TEXELS", (17, 33, 65))
    planes, texels = accuracy.by_planes(), accuracy.by_texels()
    found = accuracy.headline({"planes": planes, "texels": texels, "mpis": []} | {"mpis": _falling()})
    assert found["depth_order_in_planes"] == pytest.approx(1, abs=0.1)
    assert found["color_order_in_planes"] == pytest.approx(1, abs=0.15)
    assert found["color_order_in_texels"] == pytest.approx(2, abs=0.1)
    assert found["depth_error_over_expected"] == pytest.approx(1, abs=0.1)


def _falling():
    return [{"joint": {"depth_error": e, "color_error": e}} for e in (3.0, 2.0, 1.0)]


def test_an_order_is_the_slope_and_a_rise_with_an_added_mpi_is_seen():
    assert accuracy.order([1.0, 0.5, 0.25], [8.0, 1.0, 0.125]) == pytest.approx(3)
    falling = [
        {
            "planes": 2**k + 1,
            "texels": 2**k + 1,
            "depth_error": 0.5**k,
            "color_error": 0.5**k,
            "expected_depth_error": 1.0,
        }
        for k in (3, 4)
    ]
    rows = {"planes": falling, "texels": falling}
    found = accuracy.headline({**rows, "mpis": _falling()})
    assert found["largest_change_with_an_added_mpi"] == pytest.approx(-1 / 3)
    found = accuracy.headline({**rows, "mpis": [*_falling(), {"joint": {"depth_error": 0.9, "color_error": 1.1}}]})
    assert found["largest_change_with_an_added_mpi"] == pytest.approx(0.1)


def test_added_mpis_lower_both_errors(monkeypatch):
    monkeypatch.setattr(accuracy, "COUNTS", (1, 2, 4))
    monkeypatch.setattr(accuracy, "FORMS", ("joint",))
    rows = [r["joint"] for r in accuracy.by_count()]
    for what in ("depth_error", "color_error"):
        assert rows[0][what] > 1.2 * rows[1][what] > 1.3 * rows[2][what]


def test_the_page_names_its_command_and_the_headline_is_flat(tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy, "PLANES", (9, 17))
    monkeypatch.setattr(accuracy, "TEXELS", (9, 17))
    monkeypatch.setattr(accuracy, "COUNTS", (1, 2))
    accuracy.Accuracy(output=tmp_path).run()
    content = json.loads((tmp_path / "accuracy.json").read_text())
    assert set(content["headline"]) == {
        "depth_order_in_planes", "color_order_in_planes", "color_order_in_texels", "depth_error_over_expected",
        "largest_change_with_an_added_mpi",
    }  # fmt: skip
    assert all(isinstance(v, float) for v in content["headline"].values())
    text = (tmp_path / "accuracy.md").read_text()
    assert f"python benchmarks/accuracy.py --output {tmp_path.name}" in text and content["made"]["commit"] in text
    assert (tmp_path / "accuracy.png").stat().st_size > 1000
