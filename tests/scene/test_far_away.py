"""Ten kilometres from the origin: a ray is moved into an MPI's frame by differences, so nothing is lost on the way."""

from __future__ import annotations

from mmpi_ns.placement.split import place_windows
from mmpi_ns.settings import PlacementConfig


def test_mpis_a_ray_can_meet_do_not_grow_with_the_road():
    """All of a ray's MPIs are those of its windows; twice the road has twice the windows."""
    from long_road import road

    config = PlacementConfig(max_texels=2e6, max_planes=32)
    short, long = (place_windows(road(length, 4.0), config) for length in (220, 440))
    most, total = ([f(len(p.mpis) for p in plan.plans) for plan in (short, long)] for f in (max, sum))
    assert len(long) >= 1.6 * len(short) >= 4
    assert 1.6 * total[0] <= total[1] <= 2.5 * total[0]
    assert most[1] <= 1.25 * most[0] + 1
