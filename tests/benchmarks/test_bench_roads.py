"""The roads benchmark on a road that is over in seconds."""

from __future__ import annotations

import json
from functools import partial

import pytest
import roads
from roads import Roads, headline, some_windows

from mmpi_scene import catalogue

SMALL = {"count": 61, "width": 160, "height": 48}
"""Images of the road, which take longer to draw than to learn."""


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    output = tmp_path_factory.mktemp("roads")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(catalogue, "make_scene", partial(catalogue.make_scene, **SMALL))
        patched.setattr(roads, "run_apart", lambda work, request, *_: work(request, print))
        Roads(lengths=(180.0,), steps=6, output=output, work=output / "work").run()
    return json.loads((output / "roads.json").read_text()), output


@pytest.mark.parametrize(("count", "wanted", "expected"), [
    (1, 5, [0]), (2, 5, [0, 1]), (9, 5, [1, 3, 4, 5, 7]), (92, 3, [23, 46, 68]),
])  # fmt: skip
def test_the_windows_trained_are_spread_over_the_road(count, wanted, expected):
    assert some_windows(count, wanted) == expected


def test_a_road_is_planned_and_some_of_its_windows_are_trained_and_rendered(content):
    rows = content[0]["rows"]
    row = rows["180 m"]
    assert row["cameras"] == SMALL["count"] and row["windows"] >= 2 and row["mpis"] >= row["windows"]
    assert row["texels"] > row["window_texels"] > 0
    assert row["plan_s"] > 0 and row["step_ms"] > 0 and row["frame_ms"] > 0 and row["peak_gib"] > 0.1
    assert row["live_samples"] > row["kept_samples"] > 1
    assert row["psnr_db"] > 8 and len(row["by_window"]) == 2
    assert row["step_ms"] == pytest.approx(sum(r["step_ms"] for r in row["by_window"]) / 2)
    assert (content[1] / "roads.png").is_file() and "180 m" in (content[1] / "roads.md").read_text()


def test_rows_that_are_there_are_kept(content, capsys):
    path = content[1] / "roads.json"
    changed = json.loads(path.read_text())
    changed["rows"]["180 m"]["plan_s"] = 12345.0
    path.write_text(json.dumps(changed))
    Roads(lengths=(180.0,), steps=6, output=content[1], work=content[1] / "work").run()
    assert "plan 12345 s" in capsys.readouterr().out


def test_ratios_are_those_of_the_longest_to_the_shortest_road():
    base = {"step_ms": 10.0, "frame_ms": 2.0, "peak_gib": 1.0, "plan_s": 1.0, "texels": 5, "windows": 1}
    long = {**base, "length": 1000.0, "step_ms": 11.0, "plan_s": 12.0, "texels": 50, "windows": 10}
    found = headline([long, {**base, "length": 100.0}])
    assert found["length_ratio"] == 10 and found["step_ms_ratio"] == pytest.approx(1.1)
    assert found["plan_s_ratio"] == 12 and found["windows_ratio"] == 10 and found["frame_ms_ratio"] == 1
