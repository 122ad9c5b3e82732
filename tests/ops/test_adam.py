"""TouchedAdam: Adam where a batch touched the table, and not a bit of change elsewhere (touched_adam.py, ops/adam)."""

from __future__ import annotations

import copy

import pytest
import torch
from compiled import both, compiled, normal  # noqa: F401
from torch.nn import Parameter

from mmpi_ns.training.touched_adam import TouchedAdam, TouchedAdamConfig

SETTINGS = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-8}


def table(rows=8, channels=3, dtype=torch.float64):
    return torch.randn(rows, channels, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def gradients(shape, steps=6, dtype=torch.float64):
    g = torch.Generator().manual_seed(1)
    return [torch.randn(shape, generator=g, dtype=torch.float64).to(dtype) for _ in range(steps)]


def sparse(rows, values, shape):
    return torch.sparse_coo_tensor(torch.tensor(rows)[None], values, shape)


def with_duplicates(dense):
    """The same gradient as sparse rows in a shuffled order, each row split in two parts."""
    rows = torch.randperm(dense.shape[0], generator=torch.Generator().manual_seed(2))
    return sparse(
        torch.cat([rows, rows.flip(0)]).tolist(),
        torch.cat([0.25 * dense[rows], 0.75 * dense[rows.flip(0)]]),
        dense.shape,
    )


def run(param, grads, optimizer):
    for grad in grads:
        param.grad = grad
        optimizer.step()
    return param


@pytest.mark.parametrize(
    ("layout", "dtype", "error"),
    [
        ("dense", torch.float32, 2e-6),
        *((layout, torch.float64, 1e-14) for layout in ("dense", "sparse", "duplicates")),
        *((layout, torch.float32, 5e-3) for layout in ("sparse", "duplicates")),  # moments in bfloat16: 2^-9 a step
    ],
)
def test_everything_touched_equals_torchs_adam(layout, dtype, error):
    grads = gradients((8, 3), dtype=dtype)
    wanted = Parameter(table(dtype=dtype))
    run(wanted, grads, torch.optim.Adam([wanted], **SETTINGS))
    form = {
        "dense": lambda g: g.clone(),
        "sparse": lambda g: sparse(range(8), g, g.shape),
        "duplicates": with_duplicates,
    }[layout]
    param = Parameter(table(dtype=dtype))
    run(param, [form(g) for g in grads], TouchedAdam([param], **SETTINGS))
    assert torch.allclose(param, wanted, rtol=error, atol=error)
    assert not torch.equal(param, table(dtype=dtype))


def test_first_step_moves_every_touched_entry_by_the_learning_rate():
    param = Parameter(torch.zeros(2, 2, dtype=torch.float64))
    param.grad = torch.tensor([[3.0, -0.001], [0.0, 5e4]], dtype=torch.float64)
    TouchedAdam([param], lr=0.1).step()
    assert torch.allclose(param, torch.tensor([[-0.1, 0.1], [0.0, -0.1]], dtype=torch.float64), atol=2e-6)


@pytest.mark.parametrize("layout", ["dense", "sparse"])
def test_untouched_rows_keep_every_bit_and_their_moments(layout):
    param = Parameter(table())
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 3), optimizer)  # give all rows moments
    before = param.detach().clone(), copy.deepcopy(optimizer.state[param])
    touched, rest = [1, 6], [0, 2, 3, 4, 5, 7]
    for grad in gradients((2, 3), 4):
        if layout == "sparse":
            param.grad = sparse(touched, grad, param.shape)
        else:
            param.grad = torch.zeros_like(param)
            param.grad[touched] = grad
        optimizer.step()
    state = optimizer.state[param]
    assert torch.equal(param[rest], before[0][rest]) and (param[touched] != before[0][touched]).all()
    assert torch.equal(state["moments"][rest], before[1]["moments"][rest])
    assert (state["moments"][touched] != before[1]["moments"][touched]).all()


@pytest.mark.parametrize("layout", ["dense", "sparse"])
def test_entries_with_zero_gradient_are_skipped_within_a_touched_row(layout):
    param = Parameter(table())
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 2), optimizer)
    before, moments = param.detach().clone(), copy.deepcopy(optimizer.state[param])
    grad = torch.zeros(8, 3, dtype=torch.float64)
    grad[4, 1] = 2.0
    param.grad = grad if layout == "dense" else sparse([4], grad[4:5], grad.shape)
    optimizer.step()
    changed = (param != before).nonzero().tolist()
    assert changed == [[4, 1]]
    changed = (optimizer.state[param]["moments"] != moments["moments"]).nonzero().tolist()
    assert changed == [[4, 0, 1], [4, 1, 1]], "mean and variance"


def test_duplicates_that_cancel_touch_nothing():
    param = Parameter(table())
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 2), optimizer)
    before = param.detach().clone()
    ones = torch.ones(1, 3, dtype=torch.float64)
    param.grad = sparse([5, 5], torch.cat([ones, -ones]), param.shape)
    optimizer.step()
    assert torch.equal(param, before)


def test_sparse_and_dense_gradients_of_the_same_batch_give_the_same_step():
    grads = gradients((8, 3), 5)
    for grad in grads:
        grad[torch.rand(8, generator=torch.Generator().manual_seed(3)) < 0.5] = 0
    dense, rows = Parameter(table()), Parameter(table())
    run(dense, [g.clone() for g in grads], TouchedAdam([dense], **SETTINGS))
    kept = [g.abs().sum(-1).nonzero()[:, 0] for g in grads]
    run(
        rows,
        [sparse(k.tolist(), g[k], g.shape) for k, g in zip(kept, grads, strict=True)],
        TouchedAdam([rows], **SETTINGS),
    )
    assert torch.allclose(dense, rows, rtol=1e-14) and not torch.equal(dense, table())


def test_bias_correction_follows_the_count_of_steps_not_of_touches():
    """As in DVGO: a texel first touched at step 3 is corrected as if it had been there all along."""
    param = Parameter(torch.zeros(2, 1, dtype=torch.float64))
    optimizer = TouchedAdam([param], **SETTINGS)
    first, second = torch.tensor([[1.0], [0.0]]).double(), torch.tensor([[1.0], [1.0]]).double()
    run(param, [first, first, second], optimizer)
    mean, square = 0.1, 0.01
    wanted = 0.1 * (mean / (1 - 0.9**3)) / ((square / (1 - 0.99**3)) ** 0.5 + 1e-8)
    assert param[1].item() == pytest.approx(-wanted)


def test_parameters_without_gradient_stay_bit_identical():
    frozen, moving = Parameter(table()), Parameter(table())
    optimizer = TouchedAdam([frozen, moving], **SETTINGS)
    run(moving, gradients((8, 3), 3), optimizer)
    assert torch.equal(frozen, table()) and frozen not in optimizer.state
    assert not torch.equal(moving, table())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("layout", ["dense", "sparse"])
def test_resumed_run_equals_an_uninterrupted_one(layout, dtype, tmp_path):
    grads = [g if layout == "dense" else sparse([0, 3, 4], g[:3], g.shape) for g in gradients((8, 3), 6, dtype)]
    whole = Parameter(table(dtype=dtype))
    run(whole, [g.clone() for g in grads], TouchedAdam([whole], **SETTINGS))
    first = Parameter(table(dtype=dtype))
    optimizer = TouchedAdam([first], **SETTINGS)
    run(first, [g.clone() for g in grads[:3]], optimizer)
    in_short = layout == "sparse" and dtype == torch.float32
    assert optimizer.state[first]["moments"].dtype == (torch.bfloat16 if in_short else dtype)
    torch.save({"optimizer": optimizer.state_dict(), "param": first.data}, tmp_path / "c.pt")
    saved = torch.load(tmp_path / "c.pt", weights_only=True)
    second = Parameter(saved["param"])
    resumed = TouchedAdam([second], lr=123.0)
    resumed.load_state_dict(saved["optimizer"])
    run(second, [g.clone() for g in grads[3:]], resumed)
    assert torch.equal(second, whole)


def test_moments_follow_the_blocks_that_are_kept():
    param, kept = Parameter(table()), torch.tensor([0, 2, 3])
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 3), optimizer)
    before = copy.deepcopy(optimizer.state[param])
    optimizer.keep_blocks(param, kept, 2)
    rows = torch.tensor([0, 1, 4, 5, 6, 7])
    state = optimizer.state[param]
    assert torch.equal(state["moments"], before["moments"][rows])
    assert state["step"] == before["step"]
    optimizer.keep_blocks(Parameter(torch.zeros(4, 1)), kept, 2)  # one that was never seen


def test_forgotten_moments_start_afresh():
    param = Parameter(table())
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 3), optimizer)
    optimizer.reset_moments(param)
    param.data = torch.zeros(20, 3, dtype=torch.float64)  # grown
    param.grad = torch.ones(20, 3, dtype=torch.float64)
    optimizer.step()
    assert torch.allclose(param, torch.full_like(param, -0.1))
    optimizer.reset_moments(Parameter(torch.zeros(1)))  # one that was never seen


def test_tiny_and_huge_gradients_give_finite_steps():
    param = Parameter(torch.zeros(4, 1))
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, [torch.tensor([[1e-30], [1e-12], [1e12], [1e18]])] * 3, optimizer)
    assert torch.isfinite(param).all() and (param.abs() <= 0.31).all()


def test_config_builds_the_optimizer_with_its_settings():
    param = Parameter(table())
    optimizer = TouchedAdamConfig(lr=0.02).setup(params=[param])
    group = optimizer.param_groups[0]
    assert isinstance(optimizer, TouchedAdam)
    assert (group["lr"], group["betas"], group["eps"]) == (0.02, (0.9, 0.99), 1e-8)


@pytest.mark.parametrize("channels", [8, 9])
def test_adam_on_rows_equals_the_plain_one_to_the_last_bits(channels):
    def work():
        param = torch.nn.Parameter(normal(500, channels))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(6):
            rows = torch.randint(0, 500, (300,), generator=torch.Generator().manual_seed(step))
            values = normal(300, channels, seed=step)
            values[:, step] = 0  # entries without a gradient within a touched row
            param.grad = torch.sparse_coo_tensor(rows[None], values, param.shape)
            if step % 2:
                param.grad = param.grad.coalesce()
            optimizer.step()
        return param.data, optimizer.state[param]["moments"].float()

    fast, plain = both(work)
    assert (plain[0] - normal(500, channels)).abs().max() > 0.3
    for a, b in zip(fast, plain, strict=True):  # here and there a moment falls on the other side of a half
        off = (a - b).abs()
        assert (off <= 4e-6 * (1 + b.abs())).float().mean() > 0.995 and (off <= 2**-7 * b.abs() + 1e-3).all()
