"""Which phase a step is in, and what trains there (phases.py)."""

from __future__ import annotations

import pytest
from training_runs import ready, schedule_of, trainer_config

from mmpi_ns.config import mmpi, mmpi_kitti, mmpi_scannet, mmpi_scannet_short
from mmpi_ns.placement.observations import Observations
from mmpi_ns.settings import ScheduleConfig
from mmpi_ns.training import phases
from mmpi_ns.training.phases import TRAINS, Phase, Schedule, make_schedule, sooner_if_coarse

KINDS = ("density", "features", "colour", "reliability", "camera_opt")


def two_phase(**settings):
    return schedule_of("two-phase", 40_000, **settings)


def test_phases_follow_each_other_and_end_with_the_run():
    schedule = two_phase(blend_share=0.25, finetune_share=0.125)
    assert schedule.phases == (
        Phase("individual", 0, 25_000),
        Phase("blend", 25_000, 35_000),
        Phase("finetune", 35_000, 40_000),
    )
    assert schedule.total_steps == 40_000


def test_only_reliability_trains_in_blend_and_everything_else_before():
    assert TRAINS["blend"] == {"reliability"}
    assert TRAINS["individual"] == TRAINS["joint"] == {"density", "features", "colour", "camera_opt"}
    assert TRAINS["finetune"] == set(KINDS)


def test_rates_fall_by_the_given_decades_over_each_phase():
    schedule = two_phase(decay_decades=2.0, finetune_share=0.25)
    assert schedule.rate_factor("density", 0) == 1.0
    assert schedule.rate_factor("density", 10_000) == pytest.approx(0.1)
    assert schedule.rate_factor("density", 19_999) == pytest.approx(0.01, rel=1e-3)
    assert schedule.rate_factor("reliability", 20_000) == 1.0
    assert schedule.rate_factor("density", 30_000) == pytest.approx(1.0)
    assert schedule.rate_factor("reliability", 35_000) == pytest.approx(0.1)
    assert schedule.rate_factor("density", 50_000) == pytest.approx(0.01)  # no further decay after the run


def test_texels_double_at_each_growth_step():
    schedule = schedule_of("joint", 30_000)
    assert schedule.growth == (2_000, 4_000, 6_000, 8_000)
    steps = (0, 1_999, 2_000, 3_999, 4_000, 6_000, 7_999, 8_000, 30_000)
    assert [schedule.texel_factor(s) for s in steps] == [1 / 16, 1 / 16, 1 / 8, 1 / 8, 1 / 4, 1 / 2, 1 / 2, 1, 1]


def test_texels_may_become_finer_at_releases_after_growth_while_rates_are_high():
    shares = {"release_shares": (3 / 15, 4 / 15, 0.3, 0.5, 0.75), "decay_from": 0.5}
    schedule = schedule_of("joint", 1_000, windows=2, **shares)
    assert [s for s in range(2_000) if schedule.refines_at(s)] == [300, 500, 1_300, 1_500]
    for steps, middle in ((1_000, 500), (1_001, 500), (1_002, 501), (1_175, 588), (4_999, 2_500)):  # rounded alike
        schedule = schedule_of("joint", steps, **shares)
        assert [s for s in schedule.release if schedule.refines_at(s, copies=True)] == [middle]
    schedule = schedule_of("joint", 1_000, **(shares | {"release_weight": 0.0}))
    assert not any(schedule.refines_at(s) for s in range(1_000)), "nothing is released"


def test_bricks_are_given_up_after_growth_and_what_is_seen_before_does_not_count():
    schedule = schedule_of("joint", 1_000, release_shares=(0.1, 0.5, 0.75, 0.5), windows=2)
    assert schedule.growth[-1] == 267 and schedule.release == (500, 750), "not before surfaces have formed, and once"
    assert [s for s in range(2_000) if schedule.releases_at(s)] == [500, 750, 1_500, 1_750]
    watched = [s for s in range(2_000) if schedule.watches(s)]
    assert watched == [*range(267, 750), *range(1_267, 1_750)]
    assert not any(schedule_of("joint", 100).watches(s) for s in range(100))
    assert schedule_of("joint", 100, growth_shares=(), release_shares=(0.1, 0.2)).release == (20,)
    assert schedule_of("two-phase", 1_000, release_shares=(1.0,)).release == (750,), "shares of the first phase"


@pytest.mark.parametrize("training", ["two-phase", "joint"])
def test_schedule_survives_json(training):
    schedule = schedule_of(training, 1234, decay_decades=0.7, decay_from=0.25, release_shares=(0.5, 0.9))
    assert Schedule.from_json(schedule.to_json()) == schedule
    assert hash(Schedule.from_json(schedule.to_json())) == hash(schedule)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"steps": 0}, "max-num-iterations"),
        ({"steps": 100, "blend_share": 0.7, "finetune_share": 0.3}, "blend-share"),
        ({"steps": 100, "growth_shares": (0.5, 0.25)}, "growth-shares"),
        ({"steps": 100, "decay_from": 1.0}, "decay-from"),
    ],
)
def test_impossible_schedules_name_the_setting(settings, word):
    with pytest.raises(ValueError, match=word):
        schedule_of("two-phase", **settings)


@pytest.mark.parametrize("method", [mmpi_kitti, mmpi_scannet, mmpi_scannet_short])
def test_the_papers_methods_keep_its_settings(method):
    model, optimizers = method.config.pipeline.model, method.config.optimizers
    assert (model.schedule.decay_decades, model.schedule.decay_from) == (1.5, 0.0)
    assert model.colour.feature_channels == 9 and optimizers["colour"]["optimizer"].lr == 1e-3
    assert (model.loss.tv_density, model.loss.tv_features) == (1e-5, 1e-6)
    assert method.config.pipeline.datamanager.pixel_jitter == 0.0
    assert mmpi.config.pipeline.model.loss.tv_density == 1e-4, "a change of one must not reach another"
    if method is mmpi_kitti:
        assert (model.schedule.training, model.schedule.rays_per_mpi) == ("two-phase", "split")
        assert (model.schedule.blend_share, model.schedule.finetune_share) == (0.25, 0.0)


@pytest.mark.parametrize(
    ("step", "name"),
    [(0, "individual"), (29_999, "individual"), *((s, "blend") for s in (30_000, 39_999, 40_000, 10**9))],
)
def test_a_phase_ends_just_before_the_next_begins(step, name):
    assert two_phase().phase_at(step).name == name


def test_a_long_run_from_surfaces_grows_no_longer_than_a_short_one():
    config = ScheduleConfig()
    short, long, fog = (
        make_schedule(config, n, has_depths=d, along_path=True)
        for n, d in ((4000, True), (16000, True), (16000, False))
    )
    assert short.growth == long.growth == (267, 533, 800, 1067)
    assert fog.growth == (1067, 2133, 3200, 4267)
    assert short.formed == long.formed == 533 and fog.formed == 4267
    assert not long.sharpened(532) and long.sharpened(533)
    assert set(long.growth[2:]) <= set(long.release), "bricks are released before they double"
    assert [s for s in long.release if s > 1067] == [2400, 4800, 8000, 12000, 15200]


def test_coarse_texels_of_a_drive_double_sooner_and_those_of_other_captures_later():
    config = ScheduleConfig()
    shares = config.growth_shares
    assert sooner_if_coarse(shares, 4.0) == sooner_if_coarse(shares, 0.0) == shares  # 16 pixels at first
    assert sooner_if_coarse(shares, 4.1) == (1 / 60, *shares[:3])
    assert sooner_if_coarse(shares, 7.8) == (1 / 60, 2 / 60, *shares[:2])  # 31.2, 22.1, 15.6 and 11 pixels
    assert sooner_if_coarse(shares, 12.0) == tuple(s / 4 for s in shares)
    assert sooner_if_coarse((), 100.0) == ()
    drive, other = (make_schedule(config, 4000, has_depths=True, along_path=a, texel_pixels=7.8) for a in (True, False))
    assert drive.growth == (67, 133, 267, 533) and drive.formed == 533
    assert [s for s in drive.release if s < 1200] == [600, 800, 1067], "after growth, which needs no release"
    assert other.growth == (400, 800, 1200, 1600) and other.formed == 800
    assert other.release == (1200, 1600, 2000, 3000, 3800), "before the last two doublings, and later"
    assert make_schedule(config, 4000, along_path=True, texel_pixels=7.8) == make_schedule(config, 4000)
    late = make_schedule(ScheduleConfig(growth_shares=(0.5, 0.9)), 1000, has_depths=True)
    assert late.growth == (750, 1000) and late.texel_factor(999) == 0.5


@pytest.mark.parametrize(
    ("along", "limit", "growth"),
    [(False, 0.1, (30, 60)), (True, 2.1, (20, 40)), (True, 1.5, (5, 20)), (True, 1.3, (5, 10))],
)
def test_a_run_takes_path_and_pixels_of_a_texel_from_its_capture(
    scene, plan_file, tmp_path, monkeypatch, along, limit, growth
):
    """``limit``: in pixels that a texel of the plan spans. Texels are 1.4 and 2 times as large before doublings."""
    if along:
        monkeypatch.setattr(Observations, "looks_along_path", True)
    trainer = ready(trainer_config(scene, plan_file, tmp_path, 160, training="joint"))
    plan, seen = trainer.pipeline.model.field.full_plan, trainer.pipeline.datamanager.observations
    u0, u1, v0, v1 = plan.mpis[0].extent
    spans = seen.intrinsics[0, 0] * min((u1 - u0) / (plan.mpis[0].width - 1), (v1 - v0) / (plan.mpis[0].height - 1))
    monkeypatch.setattr(phases, "COARSE_PIXELS", limit * spans)
    again = ready(trainer_config(scene, plan_file, tmp_path / "again", 160, training="joint"))
    assert again.pipeline.model.progress.schedule.growth == growth
