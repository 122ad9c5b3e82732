"""``mmpi-bench scaling``: what is live, what is allocated, and the lines through them."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import pytest

from mmpi_ns.bench.speed import scaling
from mmpi_ns.bench.speed.scaling import Point, Scaling, fit, headline, measure, points

SMALL = Point("s", mpis=2, planes=8, height=8, width=8, rays=32)


def one(point):
    return measure({**asdict(point), "steps": 1}, print)


def test_mpis_that_face_away_are_allocated_but_not_live():
    alone, more = one(SMALL), one(replace(SMALL, elsewhere=3))
    assert alone["live"] == more["live"] > 4
    # A plane of 8 x 8 texels is one brick; one more is empty.
    assert alone["texels"] == (2 * 8 + 1) * 64 and more["texels"] == (5 * 8 + 1) * 64
    assert more["table_bytes"] > 2 * alone["table_bytes"]


def test_more_planes_are_more_live_samples_and_more_texels_are_not():
    alone = one(SMALL)
    assert one(replace(SMALL, planes=16))["live"] == pytest.approx(2 * alone["live"], rel=0.15)
    finer = one(replace(SMALL, height=16, width=16))
    assert finer["live"] == alone["live"] and finer["texels"] == (4 * 2 * 8 + 1) * 64
    assert all(math.isfinite(v) for v in finer.values())


def test_points_differ_from_the_base_in_one_thing():
    base = asdict(scaling.BASE)
    for point in points():
        changed = [k for k, v in asdict(point).items() if k != "series" and v != base[k]]
        assert len(changed) <= (2 if point.series == "texels" else 1), point
    assert len({(p.series, p.name) for p in points()}) == len(points())


def test_a_line_is_fitted():
    slope, offset, straight = fit([1, 2, 3], [5, 7, 9])
    assert (slope, offset, straight) == (pytest.approx(2), pytest.approx(3), pytest.approx(1))
    assert fit([0, 1, 2, 3], [0, 1, 0, 1])[2] == pytest.approx(0.2)
    assert fit([0, 1, 2], [0, 0, 0])[2] == 1, "nothing to explain"


def row(series, live, step_ms, texels, rays=1024, elsewhere=0):
    made = {"series": series, "live": live, "step_ms": step_ms, "march_ms": step_ms / 2, "texels": texels, "mpis": 4}
    return {**made, "rays": rays, "elsewhere": elsewhere, "table_bytes": 100 + 36 * texels,
            "gained_gib": texels / 2**20}  # fmt: skip


def test_the_headline_is_slopes_at_equal_rays():
    rows = [row("planes", n, 10 + n, 50 * n) for n in (16, 64)]
    rows += [row("MPIs not met", 64, 74, 3200), row("MPIs not met", 64, 76, 12800, elsewhere=12)]
    rows += [row("rays", 64, 37, 3200, 512), row("rays", 64, 148, 3200, 2048)]
    found = headline(rows)
    assert found["process_bytes_per_texel"] == pytest.approx(1024)
    assert found["bytes_per_texel"] == pytest.approx(36) and found["bytes_over_texels_r2"] == pytest.approx(1)
    # 48 live samples take 26 ms to (74 + 74 + 76) / 3 ms, over 1,024 rays.
    assert found["step_ns_per_live_sample"] == pytest.approx(1e6 / 1024 * (74 + 2 / 3 - 26) / 48, rel=1e-6)
    assert found["march_with_unmet_over_without"] == pytest.approx(76 / 74)
    assert found["heads_with_unmet_over_without"] == 4 and found["time_over_rays_exponent"] == pytest.approx(1)


def test_scaling_end_to_end_and_again(tmp_path, monkeypatch):
    sizes = [("planes", {}), ("planes", {"planes": 16}), ("MPIs not met", {}), ("MPIs not met", {"elsewhere": 2})]
    sizes += [("rays", {}), ("rays", {"rays": 64})]
    chosen = [replace(SMALL, series=series, **changes) for series, changes in sizes]
    monkeypatch.setattr(scaling, "points", lambda: chosen)
    monkeypatch.setattr(scaling, "run_apart", lambda work, request, folder, threads: work(request, print))
    monkeypatch.setattr(scaling, "BASE", SMALL)
    Scaling(steps=1, threads=1, output=tmp_path, work=tmp_path).run()
    found = json.loads((tmp_path / "scaling.json").read_text())
    assert len(found["rows"]) == 6 and all(math.isfinite(v) for v in found["headline"].values())
    assert (tmp_path / "scaling.md").read_text().count("\n| planes |") == 2
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    monkeypatch.setattr(scaling, "run_apart", lambda *_: {"not_run": "it failed"})
    Scaling(steps=1, threads=1, output=tmp_path, work=tmp_path).run()
    with pytest.raises(ValueError, match="it failed"):
        Scaling(steps=2, threads=1, output=tmp_path, work=tmp_path).run()
