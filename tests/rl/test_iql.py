import math

import pytest
import torch

from lerobot_wm.rl import iql
from lerobot_wm.rl.bc import bc_loss


def test_expectile_loss_is_asymmetric() -> None:
    assert iql.expectile_loss(torch.tensor([2.0]), 0.7).item() == pytest.approx(0.7 * 4)
    assert iql.expectile_loss(torch.tensor([-2.0]), 0.7).item() == pytest.approx(0.3 * 4)


def test_value_regression_finds_the_expectile() -> None:
    # The τ-expectile of {0, 1} in equal parts is τ.
    v = torch.zeros(1, requires_grad=True)
    q = torch.tensor([0.0, 1.0])
    optimizer = torch.optim.SGD([v], lr=0.2)
    for _ in range(400):
        optimizer.zero_grad()
        iql.value_loss(q, v.expand(2), 0.7).backward()
        optimizer.step()
    assert v.item() == pytest.approx(0.7, abs=1e-3)


def test_terminal_transitions_do_not_bootstrap() -> None:
    reward, next_v = torch.tensor([1.0, 0.0]), torch.tensor([5.0, 5.0])
    target = iql.critic_target(reward, next_v, torch.tensor([True, False]), 0.99)
    assert target.tolist() == pytest.approx([1.0, 4.95])


def test_critic_loss_leaves_out_transitions_without_a_successor() -> None:
    qs = torch.tensor([[0.0, 9.0], [2.0, 9.0]])
    loss = iql.critic_loss(qs, torch.tensor([1.0, 0.0]), torch.tensor([True, False]))
    assert loss.item() == pytest.approx(2.0)


def test_beta_multiplies_the_advantage_and_the_weight_is_clipped() -> None:
    weights = iql.advantage_weight(torch.tensor([1.0, -1.0, 1000.0]), beta=0.5)
    assert weights.tolist() == pytest.approx([math.exp(0.5), math.exp(-0.5), 100.0])


def test_log_prob_equals_torch_distributions() -> None:
    torch.manual_seed(0)
    mean, action, log_std = torch.randn(3, 4), torch.randn(3, 4), torch.rand(4) - 1
    theirs = torch.distributions.Normal(mean, log_std.exp()).log_prob(action).sum(-1)
    torch.testing.assert_close(iql.gaussian_log_prob(mean, log_std, action), theirs)


def test_gradients_reach_only_their_own_network() -> None:
    q, v = torch.tensor([1.0], requires_grad=True), torch.tensor([0.0], requires_grad=True)
    iql.value_loss(q, v, 0.7).backward()
    assert q.grad is None
    assert v.grad is not None
    assert not iql.critic_target(torch.ones(1), v, torch.zeros(1), 0.99).requires_grad
    assert not iql.advantage_weight(v, 0.5).requires_grad


def test_bc_loss_is_the_mean_over_batch_and_action() -> None:
    assert bc_loss(torch.zeros(2, 2), torch.tensor([[1.0, 0.0], [0.0, 1.0]])).item() == pytest.approx(0.5)
