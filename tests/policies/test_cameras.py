"""Which cameras a policy sees, and how their images become one."""

from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_wm.nn.images import camera_images, resize_images, side_by_side, stack_images
from lerobot_wm.policies.common.acting_policy import check_observation
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.config import RSSMConfig

LEFT, RIGHT = "observation.images.left", "observation.images.right"


def make_config(
    left: tuple[int, int, int] = (3, 64, 64), right: tuple[int, int, int] = (3, 48, 96), **options: Any
) -> WMRSSMConfig:
    return WMRSSMConfig(
        rssm=RSSMConfig(deter_dim=16, stoch_dim=8, hidden_dim=16, reward_hidden_dim=16),
        device="cpu",
        input_features={
            LEFT: PolicyFeature(FeatureType.VISUAL, left),
            RIGHT: PolicyFeature(FeatureType.VISUAL, right),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **options,
    )


@pytest.mark.parametrize(
    ("image_key", "cameras"),
    [
        (None, [LEFT, RIGHT]),
        (RIGHT, [RIGHT]),
        (f"{RIGHT}, {LEFT}", [RIGHT, LEFT]),
    ],
)
def test_cameras_are_stacked_in_the_order_given(image_key: str | None, cameras: list[str]) -> None:
    config = make_config(image_key=image_key)
    config.validate_features()
    assert config.cameras == cameras
    assert config.rssm.image_channels == 3 * len(cameras)
    batch = {LEFT: torch.rand(2, 5, 3, 64, 64), RIGHT: torch.rand(2, 5, 3, 48, 96)}
    images = camera_images(batch, config.cameras, config.image_size)
    assert images.shape == (2, 5, 3 * len(cameras), 64, 64)
    for key, image in zip(cameras, images.split(3, dim=2), strict=True):
        assert torch.equal(image, resize_images(batch[key], (64, 64)))


def test_one_camera_of_the_right_size_is_not_copied() -> None:
    images = torch.rand(2, 5, 3, 64, 64)
    assert stack_images([images], (64, 64)) is images


def test_pictures_stand_side_by_side() -> None:
    left, right = torch.rand(2, 7, 3, 4, 5)
    picture = side_by_side(torch.cat([left, right], dim=1), 2)
    assert torch.equal(picture, torch.cat([left, right], dim=3))


def test_each_camera_is_reconstructed_and_matters_to_the_latent() -> None:
    torch.manual_seed(0)
    policy = WMRSSMPolicy(make_config())
    batch = {
        LEFT: torch.rand(2, 4, 3, 64, 64),
        RIGHT: torch.rand(2, 4, 3, 48, 96),
        "action": torch.rand(2, 4, 2),
        "action_is_pad": torch.zeros(2, 4, dtype=torch.bool),
        "next.reward": torch.zeros(2, 4),
    }
    policy(batch)[0].backward()
    by_channel = policy.world_model.decoder.layers[-1].bias.grad
    assert by_channel.shape == (6,)
    assert bool((by_channel != 0).all())
    with torch.no_grad():
        model, actions = policy.world_model, batch["action"]
        latent = model.filter(
            camera_images(batch, policy.config.cameras, policy.config.image_size), actions
        ).latent
        for key in (LEFT, RIGHT):
            other = camera_images(
                {**batch, key: 1 - batch[key]}, policy.config.cameras, policy.config.image_size
            )
            assert not torch.allclose(latent, model.filter(other, actions).latent), key


@pytest.mark.parametrize(
    ("image_key", "right", "message"),
    [
        ("observation.image", (3, 48, 96), r"image_key is 'observation\.image'.*left, .*right\."),
        (f"{LEFT},{LEFT}", (3, 48, 96), rf"image_key is '{LEFT},{LEFT}'"),
        (f"{LEFT},{RIGHT}", (1, 48, 96), r"left': 3, .*right': 1.*--policy\.image_key"),
    ],
)
def test_wrong_choices_are_refused(image_key: str | None, right: tuple[int, int, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_config(right=right, image_key=image_key).validate_features()


def test_what_is_shown_is_checked_camera_by_camera() -> None:
    config = make_config()
    config.validate_features()
    left = torch.zeros(1, 3, 64, 64)
    check_observation(config, {LEFT: left, RIGHT: torch.zeros(1, 3, 48, 96)})
    with pytest.raises(ValueError, match=r"right' is \(3, 64, 64\).*\(3, 48, 96\)"):
        check_observation(config, {LEFT: left, RIGHT: left})
    with pytest.raises(
        ValueError, match=r"right; the observation has observation\.images\.left\. .*rename_map"
    ):
        check_observation(config, {LEFT: left})


@pytest.mark.parametrize("scale", [torch.uint8, torch.float32])
def test_bytes_of_a_camera_are_refused(scale: torch.dtype) -> None:
    """Resizing would wrap them round; the policy would act on noise."""
    config = make_config()
    config.validate_features()
    shown = {LEFT: torch.ones(1, 3, 64, 64), RIGHT: torch.full((1, 3, 48, 96), 200).to(scale)}
    with pytest.raises(ValueError, match=rf"right' is {scale} .* 200; expected .* \[0, 1\]"):
        check_observation(config, shown)
