import torch

from lerobot_wm.rl.bc import FlowHead


def test_the_flow_keeps_both_ways_to_solve_a_task() -> None:
    """Regression would aim between them, where no demonstration is."""
    torch.manual_seed(0)
    head = FlowHead(1, [64, 64], 2, dropout=0.0)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    observation = torch.ones(256, 1)
    for _ in range(400):
        side = torch.randint(0, 2, (256, 1)) * 2.0 - 1
        loss = head.errors(observation, torch.cat([side, -side], dim=1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        sampled = head(observation, torch.randn(256, 2))
    left = (sampled[:, 0] < 0).float().mean().item()
    assert 0.3 < left < 0.7
    assert ((sampled[:, 0].abs() - 1).abs() < 0.2).float().mean() > 0.9
    assert (sampled.sum(1).abs() < 0.3).float().mean() > 0.9  # the two numbers belong together


def test_samples_depend_on_the_observation_and_follow_from_the_noise() -> None:
    torch.manual_seed(0)
    head = FlowHead(1, [64, 64], 1, dropout=0.0)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    for _ in range(400):
        observation = torch.rand(256, 1) * 2 - 1
        loss = head.errors(observation, observation).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    places, noise = torch.tensor([[-0.8], [0.0], [0.8]]), torch.randn(3, 1)
    with torch.no_grad():
        sampled = head(places, noise)
        assert torch.equal(sampled, head(places, noise))
    assert (sampled - places).abs().max() < 0.15
