import pytest
import torch
from torch import Tensor

from lerobot_wm.nn.mlp import MLP
from lerobot_wm.rl import iql
from lerobot_wm.rl.iql import IQLAgent

OBSERVATION_DIM, ACTION_DIM, BATCH = 6, 2, 32


def make_agent(betas: list[float], dropout: float = 0.0) -> IQLAgent:
    torch.manual_seed(0)
    return IQLAgent(
        OBSERVATION_DIM,
        ACTION_DIM,
        betas=betas,
        hidden_dims=[16, 16],
        dropout=dropout,
        expectile=0.7,
        discount=0.99,
        target_rate=0.1,
    )


def transitions(seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "observation": torch.randn(BATCH, OBSERVATION_DIM, generator=generator),
        "next_observation": torch.randn(BATCH, OBSERVATION_DIM, generator=generator),
        "action": torch.rand(BATCH, ACTION_DIM, generator=generator) * 2 - 1,
        "reward": torch.rand(BATCH, generator=generator),
        "terminal": torch.rand(BATCH, generator=generator) < 0.2,
        "has_next": torch.ones(BATCH, dtype=torch.bool),
    }


def train(agent: IQLAgent, steps: int) -> dict[str, Tensor]:
    optimizer = torch.optim.Adam(agent.param_groups(), lr=1e-2)
    parts: dict[str, Tensor] = {}
    for step in range(steps):
        loss, parts = agent.loss(**transitions(step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        agent.update_target()
    return parts


def test_the_sum_of_the_parts_is_the_loss() -> None:
    loss, parts = make_agent([0.5, 3.0]).loss(**transitions(0))
    names = ("value_loss", "critic_loss", "actor_loss", "actor_loss_beta3")
    assert loss.item() == pytest.approx(sum(parts[name].item() for name in names), rel=1e-6)


def test_further_actors_leave_the_main_one_and_the_critics_untouched() -> None:
    alone, swept = make_agent([0.5]), make_agent([0.5, 0.0, 3.0])
    parts, swept_parts = train(alone, 10), train(swept, 10)
    assert parts == {name: swept_parts[name] for name in parts}
    weights, swept_weights = alone.state_dict(), swept.state_dict()
    for name in weights:
        assert torch.equal(weights[name], swept_weights[name]), name


def test_beta_zero_is_behaviour_cloning_by_likelihood() -> None:
    agent, batch = make_agent([0.5, 0.0]), transitions(0)
    _, parts = agent.loss(**batch)
    mean, log_std = agent.actors[1](batch["observation"])
    likelihood = iql.gaussian_log_prob(mean, log_std, batch["action"]).mean()
    assert parts["actor_loss_beta0"].item() == pytest.approx(-likelihood.item(), rel=1e-6)


def test_beta_chooses_the_actor() -> None:
    agent, observation = make_agent([0.5, 3.0]), transitions(0)["observation"]
    for beta, actor in zip((0.5, 3.0), agent.actors, strict=True):
        assert torch.equal(agent.mean_action(observation, beta), actor(observation)[0])
    assert not torch.equal(agent.mean_action(observation, 0.5), agent.mean_action(observation, 3.0))


def test_a_large_beta_prefers_the_better_of_two_actions() -> None:
    # One state, two demonstrated actions, one of them rewarded: cloning averages them, a large beta does not.
    agent = make_agent([0.0, 10.0])
    good = torch.arange(BATCH) % 2 == 0
    batch = {
        **transitions(0),
        "observation": torch.zeros(BATCH, OBSERVATION_DIM),
        "action": torch.where(good[:, None], 0.5, -0.5).expand(BATCH, ACTION_DIM),
        "reward": good.float(),
        "terminal": torch.ones(BATCH, dtype=torch.bool),
    }
    optimizer = torch.optim.Adam(agent.param_groups(), lr=1e-2)
    for _ in range(200):
        loss, _ = agent.loss(**batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        agent.update_target()
    state = torch.zeros(1, OBSERVATION_DIM)
    assert agent.mean_action(state, 0.0).abs().max() < 0.1
    assert agent.mean_action(state, 10.0).min() > 0.4


@pytest.mark.parametrize("talking", ["actors", "critic", "value", None])
def test_each_loss_alone_sends_a_gradient_into_the_observation(talking: str | None) -> None:
    agent, batch = make_agent([0.5]), transitions(0)
    for name, network in agent.named_children():
        for module in network.modules():
            if isinstance(module, MLP) and name in {"actors", "critic", "value"} - {talking}:
                torch.nn.init.zeros_(module.head.weight)  # its output no longer depends on the observation
    observation = batch["observation"].requires_grad_()
    agent.loss(**batch)[0].backward()
    assert bool(observation.grad.abs().sum() > 0) is (talking is not None)


def test_further_actors_and_the_next_observation_get_no_gradient() -> None:
    batch = transitions(0)
    gradients = []
    for betas in ([0.5], [0.5, 3.0]):
        observation = batch["observation"].clone().requires_grad_()
        following = batch["next_observation"].clone().requires_grad_()
        loss, _ = make_agent(betas).loss(
            **{**batch, "observation": observation, "next_observation": following}
        )
        loss.backward()
        assert following.grad is None
        gradients.append(observation.grad)
    assert gradients[0].abs().sum() > 0
    assert torch.equal(gradients[0], gradients[1])


def test_only_frames_with_a_successor_or_success_train_the_critics() -> None:
    agent = make_agent([0.5])
    batch = {**transitions(0), "has_next": torch.zeros(BATCH, dtype=torch.bool)}
    never, always = torch.zeros(BATCH, dtype=torch.bool), torch.ones(BATCH, dtype=torch.bool)
    assert agent.loss(**{**batch, "terminal": never})[1]["critic_loss"] == 0
    _, parts = agent.loss(**{**batch, "terminal": always})
    qs = agent.critic(batch["observation"], batch["action"])
    assert parts["critic_loss"].item() == pytest.approx(
        2 * (qs - batch["reward"]).square().mean().item(), rel=1e-5
    )


def test_every_trained_parameter_is_in_one_group_and_the_actors_come_first() -> None:
    agent = make_agent([0.5, 3.0])
    groups = [{id(p) for p in group["params"]} for group in agent.param_groups()]
    assert groups[0] == {id(p) for p in agent.actors.parameters()}
    trained = [id(p) for p in agent.parameters() if p.requires_grad]
    assert sorted(trained) == sorted(id(p) for group in agent.param_groups() for p in group["params"])
    assert not set(map(id, agent.target_critic.parameters())) & set.union(*groups)


def test_every_trained_parameter_gets_a_gradient_in_bfloat16() -> None:
    # PyTorch before 2.11 lost that of weights which a pass without gradient had read first.
    agent = make_agent([0.5, 3.0])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss, _ = agent.loss(**transitions(0))
    loss.backward()
    without = [
        name for name, weight in agent.named_parameters() if weight.requires_grad and weight.grad is None
    ]
    assert without == []
