"""TouchedAdam: Adam where a batch touched the table, and not a bit of change elsewhere (touched_adam.py, ops/adam)."""

from __future__ import annotations

import copy

import pytest
import torch
from compiled import both, compiled, normal  # noqa: F401
from torch.nn import Parameter

from mmpi_ns.ops.interpolate import Table
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.training.touched_adam import TouchedAdam

SETTINGS = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-8}


def table(rows=8, channels=3, dtype=torch.float64):
    return torch.randn(rows, channels, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def parameter(layout, dtype=torch.float64):
    """The same numbers as an ordinary parameter, or as a table whose rows come after the empty brick."""
    values = table(dtype=dtype)
    return Parameter(values) if layout == "dense" else Table(torch.cat([torch.zeros(BRICK, 3, dtype=dtype), values]))


def gradients(shape, steps=6, dtype=torch.float64):
    g = torch.Generator().manual_seed(1)
    return [torch.randn(shape, generator=g, dtype=torch.float64).to(dtype) for _ in range(steps)]


def give(param, values, rows=range(8), parts=(1.0,)):
    """Sets the gradient of some rows; a table's comes in parts, which are added."""
    param.grad = None
    if not isinstance(param, Table):
        param.grad = torch.zeros_like(param)
        param.grad[list(rows)] = values
        return
    for part in parts:
        param.add_grad(BRICK + torch.tensor(list(rows)), part * values)


def run(param, grads, optimizer, parts=(1.0,)):
    for grad in grads:
        give(param, grad, range(len(grad)), parts)
        optimizer.step()
    return param


@pytest.mark.parametrize(
    ("layout", "parts", "dtype", "error"),
    [
        ("dense", (1.0,), torch.float32, 2e-6),
        ("dense", (1.0,), torch.float64, 1e-14),
        *(("rows", parts, torch.float64, 1e-14) for parts in ((1.0,), (0.25, 0.75))),
        *(("rows", parts, torch.float32, 5e-3) for parts in ((1.0,), (0.25, 0.75))),  # bfloat16: 2^-9 a step
    ],
)
def test_everything_touched_equals_torchs_adam(layout, parts, dtype, error):
    grads, plain = gradients((8, 3), dtype=dtype), Parameter(table(dtype=dtype))
    run(plain, grads, torch.optim.Adam([plain], **SETTINGS))
    param = parameter(layout, dtype)
    run(param, grads, TouchedAdam([param], **SETTINGS), parts)
    assert torch.allclose(param[-8:], plain, rtol=error, atol=error)
    assert not torch.equal(param[-8:], table(dtype=dtype))


@pytest.mark.parametrize("layout", ["dense", "rows"])
def test_untouched_rows_keep_every_bit_and_their_moments(layout):
    param = parameter(layout)
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 3), optimizer)  # give all rows moments
    before = param.detach().clone(), optimizer.state[param]["moments"].clone()
    touched, first = [1, 6], len(param) - 8
    for grad in gradients((2, 3), 4):
        give(param, grad, touched)
        optimizer.step()
    rest = [i for i in range(len(param)) if i - first not in touched]
    changed, moments = [first + i for i in touched], optimizer.state[param]["moments"]
    assert torch.equal(param[rest], before[0][rest]) and (param[changed] != before[0][changed]).all()
    assert torch.equal(moments[rest], before[1][rest]) and (moments[changed] != before[1][changed]).all()


@pytest.mark.parametrize("layout", ["dense", "rows"])
def test_entries_with_zero_gradient_are_skipped_within_a_touched_row(layout):
    param = parameter(layout)
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 2), optimizer)
    before, moments, row = param.detach().clone(), optimizer.state[param]["moments"].clone(), len(param) - 4
    give(param, torch.tensor([[0.0, 2.0, 0.0]]).double(), [4])
    optimizer.step()
    assert (param != before).nonzero().tolist() == [[row, 1]]
    changed = (optimizer.state[param]["moments"] != moments).nonzero().tolist()
    assert changed == [[row, 0, 1], [row, 1, 1]], "mean and variance"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_empty_brick_is_left_alone(dtype):
    param = parameter("rows", dtype)
    param.add_grad(torch.tensor([0, 63, 64]), torch.ones(3, 3, dtype=dtype))
    optimizer = TouchedAdam([param], **SETTINGS)
    optimizer.step()
    moved = (param != parameter("rows", dtype)).any(1).nonzero()[:, 0]
    assert moved.tolist() == [64] == optimizer.state[param]["moments"].any(-1).any(-1).nonzero()[:, 0].tolist()


def test_parts_that_cancel_touch_nothing():
    param = parameter("rows")
    optimizer = TouchedAdam([param], **SETTINGS)
    run(param, gradients((8, 3), 2), optimizer)
    before = param.detach().clone()
    give(param, torch.ones(1, 3).double(), [5], parts=(1.0, -1.0))
    optimizer.step()
    assert torch.equal(param, before)


def test_bias_correction_follows_the_count_of_steps_not_of_touches():
    """As in DVGO: a texel first touched at step 3 is corrected as if it had been there all along."""
    param = Parameter(torch.zeros(2, 1, dtype=torch.float64))
    optimizer = TouchedAdam([param], **SETTINGS)
    first, second = torch.tensor([[1.0], [0.0]]).double(), torch.tensor([[1.0], [1.0]]).double()
    run(param, [first, first, second], optimizer)
    mean, square = 0.1, 0.01
    wanted = 0.1 * (mean / (1 - 0.9**3)) / ((square / (1 - 0.99**3)) ** 0.5 + 1e-8)
    assert param[1].item() == pytest.approx(-wanted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("layout", ["dense", "rows"])
def test_resumed_run_equals_an_uninterrupted_one(layout, dtype, tmp_path):
    grads = gradients((3, 3), 6, dtype)
    whole = parameter(layout, dtype)
    run(whole, grads, TouchedAdam([whole], **SETTINGS))
    first = parameter(layout, dtype)
    optimizer = TouchedAdam([first], **SETTINGS)
    run(first, grads[:3], optimizer)
    in_short = layout == "rows" and dtype == torch.float32
    assert optimizer.state[first]["moments"].dtype == (torch.bfloat16 if in_short else dtype)
    torch.save({"optimizer": optimizer.state_dict(), "param": first.data}, tmp_path / "c.pt")
    saved = torch.load(tmp_path / "c.pt", weights_only=True)
    second = type(first)(saved["param"])
    resumed = TouchedAdam([second], lr=123.0)
    resumed.load_state_dict(saved["optimizer"])
    run(second, grads[3:], resumed)
    assert torch.equal(second, whole)


def test_moments_follow_the_bricks_that_are_kept():
    param, kept = Parameter(torch.zeros(4 * BRICK, 3, dtype=torch.float64)), torch.tensor([0, 2, 3])
    optimizer = TouchedAdam([param], **SETTINGS)
    for values in gradients((4 * BRICK, 3), 3):
        give(param, values, range(4 * BRICK))
        optimizer.step()
    before = copy.deepcopy(optimizer.state[param])
    optimizer.keep_bricks(param, kept)
    state = optimizer.state[param]
    assert torch.equal(state["moments"], torch.cat([before["moments"][:BRICK], before["moments"][2 * BRICK :]]))
    assert state["step"] == before["step"]
    optimizer.keep_bricks(Parameter(torch.zeros(4, 1)), kept)  # one that was never seen


@pytest.mark.parametrize("channels", [8, 9])
def test_adam_on_rows_equals_the_plain_one_to_the_last_bits(channels):
    def work():
        param = Table(normal(500, channels))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(6):
            values = normal(300, channels, seed=step)
            values[:, step] = 0  # entries without a gradient within a touched row
            param.grad = None
            param.add_grad(chosen_rows(500, 300, step), values)
            optimizer.step()
        return param.data, optimizer.state[param]["moments"].float()

    fast, plain = both(work)
    assert (plain[0] - normal(500, channels)).abs().max() > 0.3
    for a, b in zip(fast, plain, strict=True):  # here and there a moment falls on the other side of a half
        off = (a - b).abs()
        assert (off <= 4e-6 * (1 + b.abs())).float().mean() > 0.995 and (off <= 2**-7 * b.abs() + 1e-3).all()


def test_steps_of_several_threads_have_the_same_bits(compiled, three_threads):  # noqa: F811
    def trained(threads):
        torch.set_num_threads(threads)
        param = Table(normal(30_000, 8))
        optimizer = TouchedAdam([param], lr=0.1)
        for step in range(4):
            param.grad = None
            param.add_grad(chosen_rows(30_000, 20_000, step), normal(20_000, 8, seed=step))
            optimizer.step()
        return optimizer.state_dict()["state"][0]["moments"].float(), param.data

    assert all(torch.equal(a, b) for a, b in zip(trained(3), trained(1), strict=True))


def chosen_rows(count, chosen, seed):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:chosen].sort().values
