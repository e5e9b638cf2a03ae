"""Dropout with cheap masks: what dropout promises, at any shape."""

import pytest
import torch

from lerobot_wm.nn.mlp import Dropout


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("p", [0.0, 0.1, 0.5, 0.9])
def test_zeroes_that_share_and_scales_the_rest(p: float, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    dropped = Dropout(p)(torch.ones(1000, 500, dtype=dtype))
    assert dropped.dtype == dtype
    scaled = dropped[dropped != 0].float()
    assert torch.allclose(scaled, torch.tensor(1 / (1 - p)), rtol=0.005)
    assert scaled.unique().numel() == 1
    zeros = (dropped == 0).float()
    assert abs(zeros.mean().item() - p) < 0.003
    # Four masks come from one random number: neighbours have to be independent all the same.
    for distance in (1, 2, 3, 4):
        together = (zeros[:, distance:] * zeros[:, :-distance]).mean().item()
        assert abs(together - p * p) < 0.003


def test_gradient_goes_where_the_unit_went() -> None:
    x = torch.randn(7, 5, requires_grad=True)  # 35 units: no whole number of random numbers
    y = Dropout(0.5)(x)
    y.sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad, torch.where(y == 0, 0.0, 2.0))
    assert torch.allclose(y, x * x.grad)


def test_seeded_and_off_when_evaluated() -> None:
    x = torch.randn(64, 3)
    layer = Dropout(0.3)
    torch.manual_seed(5)
    first = layer(x)
    assert not torch.equal(first, layer(x))
    torch.manual_seed(5)
    assert torch.equal(first, layer(x))
    assert layer.eval()(x) is x
    assert layer.train()(x[:0]).shape == (0, 3)


@pytest.mark.parametrize(("p", "kept"), [(1e-7, 5000), (1 - 1e-7, 0)])
def test_probability_finer_than_its_levels(p: float, kept: int) -> None:
    """To the nearest level these are 0 and 1: the latter ended in a division by zero."""
    torch.manual_seed(0)
    assert Dropout(p)(torch.ones(5000)).count_nonzero() == kept


@pytest.mark.parametrize("p", [-0.1, 1.0])
def test_impossible_probability_is_refused(p: float) -> None:
    with pytest.raises(ValueError, match="expected a probability"):
        Dropout(p)
