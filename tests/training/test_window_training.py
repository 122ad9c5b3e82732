"""Windows trained one after the other, and mixed where they overlap."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import WINDOW_STEPS as STEPS
from training_runs import compared, differences, facing, load, ready, rendered, trainer_config

from mmpi_ns.field.tables import in_half_precision
from mmpi_ns.placement.defaults import RAYS, steps_for
from mmpi_ns.placement.split import most_pixels
from mmpi_ns.scene.windows import WindowedPlan, window_shares
from mmpi_ns.training.initial import start_from_depths
from mmpi_ns.training.phases import Schedule


def test_each_window_gets_all_steps_and_a_file(whole):
    steps = sorted(int(p.stem[5:]) for p in whole.checkpoint_dir.iterdir())
    assert steps == list(range(1, 2 * STEPS))
    assert sorted(p.name for p in (whole.base_dir / "windows").iterdir()) == ["window-00000.pt", "window-00001.pt"]


@pytest.mark.parametrize(("shading", "counts"), [("ray", [1, 1]), ("sample", [2, 1])])
def test_each_window_has_networks_of_its_own(scene, windows_file, tmp_path, shading, counts):
    trainer = ready(trainer_config(scene, windows_file, tmp_path, 2, training="joint", shading=shading))
    trainer.train()
    states = [load(trainer.checkpoint_dir, step)["pipeline"] for step in (1, 2)]
    assert [len(s["_model.field.networks.weights"]) for s in states] == counts
    networks = trainer.pipeline.model.field.networks
    networks.resize(1)
    trained = states[1]["_model.field.networks.weights"]
    assert (trained - networks.weights).abs().max() < 0.01, "the first window's went on"


def test_a_window_draws_from_its_own_cameras_alone(whole):
    manager, model = whole.pipeline.datamanager, whole.pipeline.model
    window = model.progress.windows.windows[1]
    manager.train()
    bundle, _ = manager.next_train(2 * STEPS)
    beyond = (bundle.origins - torch.tensor(window.center)).norm(dim=-1)
    assert len(bundle) == 80 and beyond.max() < window.radius + window.margin
    centers = torch.from_numpy(manager.observations.centers)
    assert ((centers - torch.tensor(window.center)).norm(dim=-1) > window.radius + window.margin).any()


def test_rays_are_jittered_beyond_as_many_as_a_window_takes_by_default(whole):
    manager, windows = whole.pipeline.datamanager, whole.pipeline.model.progress.windows.windows
    rays = RAYS * steps_for(most_pixels(manager.observations, windows))
    assert manager.jitter_from == STEPS + rays / manager.config.train_num_rays_per_batch > STEPS + 2000


def test_a_finished_window_is_the_model_of_the_checkpoint_at_its_end(whole):
    state = torch.load(whole.base_dir / "windows" / "window-00000.pt", weights_only=True)
    at_end = load(whole.checkpoint_dir, STEPS - 1)["pipeline"]
    for name, value in state["field"].items():
        assert torch.equal(value, at_end[f"_model.field.{name}"]), name


def test_the_second_window_learns_as_it_would_alone(whole, scene, tmp_path, monkeypatch):
    """Nothing of the first one is left in tables, networks, moments, rates or growth."""
    alone = WindowedPlan.single(whole.pipeline.model.progress.windows.plans[1])
    path = tmp_path / "plan.json"
    path.write_text(alone.to_json())
    trainer = ready(trainer_config(scene, path, tmp_path, STEPS, training="joint"))
    window = whole.pipeline.model.progress.windows.windows[1]
    manager = trainer.pipeline.datamanager
    near = np.linalg.norm(manager.observations.centers - np.asarray(window.center), axis=-1)
    manager.use_cameras(np.nonzero(near < window.radius + window.margin)[0])
    trainer.pipeline.model.run._drawn_from = 0  # a single window would draw from all cameras, and start from them
    start_from_depths(trainer.pipeline.model.field, manager.sources, manager.config.seed)
    model, draw = trainer.pipeline.model, manager.next_train
    manager.next_train = lambda step: draw(step + STEPS)  # the draws of the later steps
    losses = model.get_loss_dict

    def later(*args, **kwargs):
        model.progress.step += STEPS
        try:
            return losses(*args, **kwargs)
        finally:
            model.progress.step -= STEPS

    model.get_loss_dict = later
    decay = Schedule.decay  # the weight of known depths falls as in the window's own steps
    monkeypatch.setattr(Schedule, "decay", lambda schedule, step: decay(schedule, step % STEPS))
    trainer.train()
    expected = whole.pipeline.model.field
    assert torch.equal(model.field.density, expected.density)
    assert torch.equal(model.field.networks.weights, expected.networks.weights)


def test_rays_are_mixed_by_where_they_start(whole):
    model = whole.pipeline.model
    first, second = (torch.tensor(w.center).float() for w in model.progress.windows.windows)
    origins = torch.stack([first, first + 0.5 * (second - first), second])
    mixed = rendered(model, origins)
    shares = window_shares(origins, model.progress.windows.windows)
    assert 0 < shares[1, 0] < 1
    each = []
    for w in (0, 1):
        field = model.field if w == 1 else model.store.load(0, model.device)
        bundle = RayBundle(origins, facing(model, origins), torch.ones(3, 1), torch.zeros(3, 1).long())
        with torch.no_grad():
            each.append(model.window_outputs(w, field, bundle))
    expected = shares[:, :1] * each[0]["rgb"] + shares[:, 1:] * each[1]["rgb"]
    torch.testing.assert_close(mixed["rgb"], expected)
    assert not torch.allclose(each[0]["rgb"], each[1]["rgb"], atol=1e-4)
    assert torch.equal(mixed["depth"][[0, 2]], torch.stack([each[0]["depth"][0], each[1]["depth"][2]]))
    assert mixed["winning_mpi"][2] == 2 and mixed["winning_mpi"][0] < 2


def test_evaluation_reads_the_windows_back(whole):
    _, pipeline, _, _ = eval_setup(whole.base_dir / "config.yml", test_mode="inference")
    model = whole.pipeline.model
    origins = torch.stack([torch.tensor(w.center).float() for w in model.progress.windows.windows])
    state = {name: x.clone() for name, x in model.field.state_dict().items()}
    model.field.load_state_dict(in_half_precision(state))  # as the last checkpoint has it
    a, b = rendered(model, origins), rendered(pipeline.model, origins)
    model.field.load_state_dict(state)
    for name in ("rgb", "depth", "winning_mpi"):
        assert torch.equal(a[name], b[name]), name


@pytest.mark.parametrize("step", [STEPS - 1, STEPS])
def test_a_resumed_run_ends_as_the_uninterrupted_one(whole, scene, windows_file, tmp_path, step):
    config = trainer_config(scene, windows_file, tmp_path, STEPS, training="joint")
    trainer = ready(config, load_dir=whole.checkpoint_dir, load_step=step)
    torch.rand(5)
    trainer.train()
    actual, wanted = (load(t.checkpoint_dir, 2 * STEPS - 1) for t in (trainer, whole))
    assert differences(compared(wanted), compared(actual)) == []
    assert torch.equal(*(t.pipeline.model.field.views.origins for t in (trainer, whole))), "texels grow where it looks"
    ours, theirs = (
        torch.load(t.base_dir / "windows" / "window-00000.pt", weights_only=True)["field"] for t in (trainer, whole)
    )
    assert differences(ours, theirs) == []


def test_resuming_with_other_steps_a_window_is_refused(whole, scene, windows_file, tmp_path):
    config = trainer_config(scene, windows_file, tmp_path, STEPS // 2, training="joint")
    with pytest.raises(ValueError, match=f"resume with --max-num-iterations {STEPS}"):
        ready(config, load_dir=whole.checkpoint_dir, load_step=2)


def test_resuming_without_the_finished_windows_is_refused_in_one_sentence(whole, scene, windows_file, tmp_path):
    folder = tmp_path / "moved" / "nerfstudio_models"
    folder.mkdir(parents=True)
    name = f"step-{STEPS:09d}.ckpt"
    (folder / name).write_bytes((whole.checkpoint_dir / name).read_bytes())
    config = trainer_config(scene, windows_file, tmp_path / "new", STEPS, training="joint")
    with pytest.raises(ValueError, match="Window 0 of the run to go on from is missing"):
        ready(config, load_dir=folder)


@pytest.mark.parametrize("harm, sentence", [("gone", "is missing"), ("cut", "is damaged")])
def test_a_lost_window_is_named_and_nothing_else_is_touched(whole, harm, sentence):
    model = whole.pipeline.model
    path = model.store.path(0)
    kept = path.read_bytes()
    model.store.forget(0)
    origins = torch.tensor([model.progress.windows.windows[0].center]).float()
    before = model.field.density.clone()
    try:
        if harm == "gone":
            path.unlink()
        else:
            path.write_bytes(kept[: len(kept) // 2])
        with pytest.raises(ValueError, match=sentence):
            rendered(model, origins)
    finally:
        path.write_bytes(kept)
    assert model.progress.window == 1 and torch.equal(model.field.density, before)
