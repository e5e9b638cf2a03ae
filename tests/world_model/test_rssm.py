"""The classic errors of recurrent world models, each caught by one test."""

import pytest
import torch
from torch import Tensor

from lerobot_wm.policies.common.config import default_dtype
from lerobot_wm.world_model.config import RSSMConfig
from lerobot_wm.world_model.model import WorldModel, reconstruction_loss, world_model_loss
from lerobot_wm.world_model.rssm import DiagonalNormal

ACTION_DIM = 2
SMALL = {"deter_dim": 32, "stoch_dim": 8, "hidden_dim": 32, "reward_hidden_dim": 32}


def make_world_model(**changes) -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(RSSMConfig(**{**SMALL, "image_channels": 3, "action_dim": ACTION_DIM, **changes}))


def two_lamps(batch: int, steps: int, seed: int) -> tuple[Tensor, Tensor]:
    """A toy environment: a_t turns two lamps, the halves of the image, up or down before o_{t+1} is seen."""
    generator = torch.Generator().manual_seed(seed)
    actions = torch.rand(batch, steps, ACTION_DIM, generator=generator) * 2 - 1
    brightness = torch.rand(batch, ACTION_DIM, generator=generator)
    frames = torch.empty(batch, steps, 3, 64, 64)
    for t in range(steps):
        frames[:, t, :, :, :32] = brightness[:, 0, None, None, None]
        frames[:, t, :, :, 32:] = brightness[:, 1, None, None, None]
        brightness = (brightness + 0.4 * actions[:, t]).clamp(0, 1)
    return frames, actions


@pytest.fixture(scope="module")
def trained() -> WorldModel:
    """A small model trained on the two lamps until it can predict them."""
    model = make_world_model(predict_reward=False, free_nats=0.1, kl_scale=5.0)
    optimizer = torch.optim.Adam(model.parameters(), 2e-3, fused=True)
    valid = torch.ones(8, 8, dtype=torch.bool)
    for step in range(150):
        images, actions = two_lamps(8, 8, seed=step)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=default_dtype("cpu") == "bfloat16"):
            loss, _ = model.loss(images, actions, valid)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.eval()


@torch.no_grad()
def prediction_error(model: WorldModel, shift: int) -> float:
    """Squared error of frames imagined from 4 context frames under actions shifted by `shift` steps."""
    images, actions = two_lamps(64, 12, seed=10_000)
    context, horizon = 4, 4
    state = model.filter(images[:, :context], actions[:, :context]).last()
    first = context - 1 + shift  # the first action of `imagine` is the one executed in the last context frame
    imagined = model.decode(model.imagine(state, actions[:, first : first + horizon]).latent)
    return (imagined - images[:, context : context + horizon]).square().mean().item()


def test_prediction_needs_the_action_of_the_same_step(trained: WorldModel) -> None:
    aligned = prediction_error(trained, shift=0)
    assert aligned < 0.8 * prediction_error(trained, shift=1)
    assert aligned < 0.8 * prediction_error(trained, shift=-1)


def test_recurrent_state_advances() -> None:
    # TorchRL before December 2025 fed every step the initial state: constant inputs gave constant latents.
    model = make_world_model()
    images, actions = torch.full((1, 6, 3, 64, 64), 0.5), torch.full((1, 6, ACTION_DIM), 0.3)
    latents = model.filter(images, actions).latent
    assert (latents.diff(dim=1).abs().amax(-1) > 1e-6).all()


@pytest.mark.parametrize("n_keypoints", [0, 8])
def test_step_by_step_filtering_equals_sequence_filtering(n_keypoints: int) -> None:
    model = make_world_model(n_keypoints=n_keypoints)
    images, actions = two_lamps(2, 9, seed=1)
    whole = model.filter(images, actions).latent
    state, prev_action = None, torch.zeros(2, 1, ACTION_DIM)
    for t in range(9):
        state = model.observe(images[:, t : t + 1], prev_action, state).last()
        prev_action = actions[:, t : t + 1]
        torch.testing.assert_close(state.latent, whole[:, t], atol=1e-5, rtol=1e-5)


def test_batch_of_two_equals_each_alone() -> None:
    model = make_world_model()
    images, actions = two_lamps(2, 6, seed=2)
    together = model.filter(images, actions).latent
    for i in range(2):
        alone = model.filter(images[i : i + 1], actions[i : i + 1]).latent
        torch.testing.assert_close(alone[0], together[i], atol=1e-5, rtol=1e-5)


def test_filter_is_causal() -> None:
    model = make_world_model()
    images, actions = two_lamps(1, 8, seed=3)
    changed_images, changed_actions = images.clone(), actions.clone()
    changed_images[:, 5:] = 0
    changed_actions[:, 4:] = 0  # a_4 acts on o_5 onwards
    before, after = model.filter(images, actions).latent, model.filter(changed_images, changed_actions).latent
    torch.testing.assert_close(before[:, :5], after[:, :5], atol=1e-6, rtol=0)
    assert not torch.allclose(before[:, 5:], after[:, 5:], atol=1e-4)


def test_padded_steps_do_not_count() -> None:
    model = make_world_model()
    images, actions = two_lamps(2, 6, seed=4)
    rewards, valid = torch.rand(2, 6), torch.ones(2, 6, dtype=torch.bool)
    valid[:, 4:] = False
    torch.manual_seed(0)
    loss, _ = model.loss(images, actions, valid, rewards)
    images[:, 4:], actions[:, 4:], rewards[:, 4:] = 0.7, 0.1, 5.0
    torch.manual_seed(0)
    changed, _ = model.loss(images, actions, valid, rewards)
    torch.testing.assert_close(loss, changed)


def test_reward_head_learns_the_reward_that_came_with_the_frame() -> None:
    # r_{t-1} from s_t: the gradient of the loss with respect to the last reward of a window is zero.
    model = make_world_model()
    images, actions = two_lamps(1, 5, seed=5)
    rewards = torch.rand(1, 5, requires_grad=True)
    loss, _ = model.loss(images, actions, torch.ones(1, 5, dtype=torch.bool), rewards)
    loss.backward()
    assert (rewards.grad[:, :-1] != 0).all()
    assert (rewards.grad[:, -1] == 0).all()


def test_free_nats_clamp_each_step_before_the_mean() -> None:
    config = RSSMConfig(free_nats=3.0, kl_scale=0.5)
    kl = torch.tensor([[1.0, 5.0]])
    loss, parts = world_model_loss(
        {"image_loss": torch.zeros(1, 2)}, kl, torch.ones(1, 2, dtype=torch.bool), config
    )
    assert parts["kl_loss"].item() == pytest.approx(4.0)
    assert parts["kl"].item() == pytest.approx(3.0)
    assert parts["under_free_nats"].item() == pytest.approx(0.5)
    assert loss.item() == pytest.approx(2.0)


def test_kl_equals_torch_distributions() -> None:
    generator = torch.Generator().manual_seed(0)
    parameters = [torch.rand(4, 7, generator=generator) + 0.1 for _ in range(4)]
    ours = DiagonalNormal(*parameters[:2]).kl(DiagonalNormal(*parameters[2:]))
    normal = torch.distributions.Normal
    theirs = torch.distributions.kl_divergence(normal(*parameters[:2]), normal(*parameters[2:])).sum(-1)
    torch.testing.assert_close(ours, theirs)


def test_paper_size() -> None:
    model = WorldModel(RSSMConfig(image_channels=3, action_dim=4))
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(6.26e6, rel=1e-3)
    assert model.config.latent_dim == 512


def test_proprioceptive_variant_reconstructs_the_state() -> None:
    model = make_world_model(use_proprio=True, proprio_dim=4)
    images, actions = two_lamps(2, 4, seed=6)
    proprio = torch.rand(2, 4, 4)
    loss, parts = model.loss(
        images, actions, torch.ones(2, 4, dtype=torch.bool), torch.zeros(2, 4), proprio=proprio
    )
    assert parts["proprio_loss"] > 0
    loss.backward()
    assert model.proprio_fusion.head.weight.grad.abs().sum() > 0


def test_actions_are_scaled_by_the_models_own_statistics() -> None:
    model, scaled = make_world_model(), make_world_model()
    scaled.action_scaling.set_range(torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 10.0]))
    images, actions = two_lamps(1, 3, seed=7)
    # a raw zero action precedes the first frame in both; choose units in which zero is zero
    scaled.action_scaling.offset.zero_()
    raw = scaled.action_scaling.inverse(actions)
    torch.testing.assert_close(scaled.filter(images, raw).latent, model.filter(images, actions).latent)


@torch.no_grad()
def test_with_hidden_actions_the_filter_sees_images_alone_and_imagination_gets_the_actions() -> None:
    model = make_world_model(hidden_action_share=0.5).eval()
    images, actions = two_lamps(2, 6, seed=0)
    states = model.filter(images, actions)
    assert torch.equal(states.latent, model.filter(images, -actions).latent)
    stepwise = model.observe(images, torch.ones(2, 6, ACTION_DIM))
    torch.testing.assert_close(stepwise.latent, states.latent)
    assert not torch.equal(states.latent, model.filter(images.flip(1), actions).latent)
    start = states.last()
    assert not torch.equal(model.imagine(start, actions).latent, model.imagine(start, -actions).latent)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_training_hides_actions_in_a_share_of_the_windows(share: float) -> None:
    model = make_world_model(hidden_action_share=share, predict_reward=False, free_nats=0.0)
    images, actions = two_lamps(64, 4, seed=0)
    actions.requires_grad_()
    loss, _ = model.loss(images, actions, torch.ones(64, 4, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(loss, actions)
    hidden = (gradient == 0).all(dim=(1, 2)).float().mean().item()
    assert hidden == pytest.approx(share, abs=0.15 if 0 < share < 1 else 0)


def test_hidden_action_share_is_between_0_and_1() -> None:
    with pytest.raises(ValueError, match=r"hidden_action_share is 1\.5"):
        RSSMConfig(hidden_action_share=1.5)


def test_action_loss_makes_the_latent_hold_what_was_acted_on() -> None:
    # The action is how bright the left lamp is: without the head nothing but the image asks for it.
    images, _ = two_lamps(16, 2, seed=0)
    actions = images[..., 0, 0, :1].repeat(1, 1, ACTION_DIM)  # (16, 2, A)
    valid = torch.ones(16, 2, dtype=torch.bool)
    model = make_world_model(action_scale=10.0, hidden_action_share=1.0, predict_reward=False)
    optimizer = torch.optim.Adam(model.parameters(), 2e-3, fused=True)
    losses = []
    for _ in range(40):
        loss, parts = model.loss(images, actions, valid)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(parts["action_loss"].item())
    assert losses[-1] < 0.25 * losses[0]
    assert model.encoder.layers[0].weight.grad.abs().max() > 0
    assert not hasattr(make_world_model(), "action_head")


def test_action_loss_predicts_the_coming_actions_of_the_episode() -> None:
    model = make_world_model(action_scale=1.0, action_horizon=3, predict_reward=False)
    images, actions = two_lamps(2, 4, seed=0)
    actions = torch.cat([actions, torch.full((2, 2, ACTION_DIM), 5.0)], dim=1)  # (2, T+K-1, A)
    valid = torch.ones(2, 6, dtype=torch.bool)

    def action_loss(actions: Tensor, valid: Tensor) -> float:
        torch.manual_seed(0)
        return model.loss(images, actions, valid)[1]["action_loss"].item()

    padded = valid.clone()
    padded[:, 4:] = False
    other = actions.clone()
    other[:, 4:] = -7.0
    assert action_loss(actions, valid) != action_loss(other, valid), "actions after the window count"
    assert action_loss(actions, padded) == action_loss(other, padded), "padding does not"
    with pytest.raises(ValueError, match="action_horizon is 0"):
        RSSMConfig(action_horizon=0)


def test_image_shift_moves_what_is_encoded_and_not_what_is_reconstructed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = make_world_model(image_channels=6, image_shift=4, predict_reward=False)
    images = torch.zeros(2, 3, 6, 64, 64)
    images[..., 32, 32] = 1.0
    valid = torch.ones(2, 3, dtype=torch.bool)
    encoded, targets = [], []
    embed = model.embed
    monkeypatch.setattr(model, "embed", lambda seen, proprio: encoded.append(seen) or embed(seen, proprio))
    monkeypatch.setattr(
        "lerobot_wm.world_model.model.reconstruction_loss",
        lambda prediction, target, *weight: (
            targets.append(target) or reconstruction_loss(prediction, target, *weight)
        ),
    )
    for training in (True, False):
        model.train(training).loss(images, torch.zeros(2, 3, ACTION_DIM), valid)
    assert torch.equal(targets[0], images)
    assert torch.equal(encoded[1], images)
    lit = encoded[0].nonzero()  # (2 windows · 3 frames · 6 channels, 5)
    assert len(lit) == 36
    places = lit[:, 3:].reshape(6, 6, 2)  # frames, channels, row and column
    assert (places == places[:, :1]).all(), "the channels of a frame move together"
    assert (places - 32).abs().max() <= 4
    assert len(places[:, 0].unique(dim=0)) > 2, "each frame moves by itself"
    with pytest.raises(ValueError, match="0 or more"):
        RSSMConfig(image_shift=-1)


@torch.no_grad()
def test_decoding_a_share_of_the_frames_descends_the_same_loss() -> None:
    images, _ = two_lamps(1, 5, seed=0)
    latents = torch.rand(1, 5, 40)
    model = make_world_model(decode_share=0.4)
    full = make_world_model()._image_loss(latents, images)
    windows = 300
    draws = model._image_loss(latents.expand(windows, -1, -1), images.expand(windows, -1, -1, -1, -1))
    assert ((draws > 0).sum(1) == 2).all(), "two of five frames of each window"
    torch.testing.assert_close(draws.mean(0, keepdim=True), full, rtol=0.25, atol=0)
    assert torch.equal(model.eval()._image_loss(latents, images), full)
    with pytest.raises(ValueError, match="at most 1"):
        RSSMConfig(decode_share=0)


@torch.no_grad()
def test_standardized_images_are_scaled_where_they_enter_and_leave() -> None:
    plain, model = make_world_model().eval(), make_world_model(standardize_images=True).eval()
    images, actions = two_lamps(2, 3, seed=0)
    latents = model.filter(images, actions).latent
    assert torch.equal(latents, plain.filter(images, actions).latent), (
        "nothing is scaled before it is known how"
    )
    mean, std = torch.tensor([0.2, 0.5, 0.6]), torch.tensor([0.1, 0.2, 0.4])
    model.image_scaling.set_standard(mean, std)
    scaled = (images - mean[:, None, None]) / std[:, None, None]
    torch.testing.assert_close(model.embed(images), plain.embed(scaled))
    model.decoder.layers[-1].weight.zero_()
    model.decoder.layers[-1].bias.zero_()
    assert torch.equal(model.decode(latents), mean[:, None, None].expand_as(images))
    error = model._image_loss(latents, images)  # of [0, 1], as without
    torch.testing.assert_close(error, (images - mean[:, None, None]).square().sum((2, 3, 4)))


def test_what_precedes_an_episode_is_the_middle_of_the_actions_range() -> None:
    """Whatever the units; whole episodes and single frames agree, and a state that is given reads its action."""
    model = make_world_model()
    images, actions = two_lamps(1, 3, seed=7)
    latents = model.filter(images, actions).latent
    model.action_scaling.set_range(torch.tensor([90.0, 40.0]), torch.tensor([110.0, 60.0]))
    raw = model.action_scaling.inverse(actions)
    torch.testing.assert_close(model.filter(images, raw).latent, latents)
    first = model.observe(images[:, :1], torch.zeros(1, 1, ACTION_DIM))
    torch.testing.assert_close(first.latent, latents[:, :1])
    rest = model.observe(images[:, 1:], raw[:, :-1], first.last())
    torch.testing.assert_close(rest.latent, latents[:, 1:])


def test_with_keypoints_the_posterior_mean_is_linear_in_what_the_encoder_found() -> None:
    model = make_world_model(n_keypoints=8)
    actions = torch.rand(4, 3, ACTION_DIM)
    one, other = torch.randn(2, 4, 3, 16)

    def mean(embeds: Tensor) -> Tensor:
        return model.filter_embeds(embeds, actions).stoch

    torch.testing.assert_close(mean((one + other) / 2), (mean(one) + mean(other)) / 2)
    assert (mean(one)[:, 1:] - mean(one)[:, :1]).abs().max() > 0.1


@pytest.mark.parametrize(
    "name", ["kl_scale", "free_nats", "reward_scale", "image_shift", "action_scale", "n_keypoints"]
)
def test_weights_below_zero_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is -1"):
        RSSMConfig(**{name: -1.0})
    with pytest.raises(ValueError, match="min_std is 0"):
        RSSMConfig(min_std=0.0)
