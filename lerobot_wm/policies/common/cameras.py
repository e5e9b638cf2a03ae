"""The cameras of a policy: which it sees, and their images stacked along channels into one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor

from lerobot_wm.constants import OBS_IMAGE, OBS_STATE
from lerobot_wm.nn.images import resize_images
from lerobot_wm.policies.common.features import image_keys

_WHITE = 1.01  # resizing and floating point may pass 1 by a little; a camera's bytes never stay below


@dataclass
class ImagePolicyConfig(PreTrainedConfig):
    """A policy that sees one camera or several.

    Args:
        image_key: Its cameras, separated by commas: observation.images.corner2,observation.images.topview. Their images
            are stacked in this order. None takes all cameras of the dataset, in its order.
    """

    image_key: str | None = None

    @property
    def cameras(self) -> list[str]:
        """Feature keys of the cameras; none for a policy without images, or before `choose_cameras`."""
        return self.image_key.split(",") if self.image_key else []

    @property
    def features_read(self) -> list[str]:
        """Keys of what the policy reads of an observation."""
        return list(self.input_features)

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) that the images of all cameras are brought to: the first camera's."""
        _, height, width = self.input_features[self.cameras[0]].shape
        return height, width

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """(C, H, W) of the stacked images."""
        channels = sum(self.input_features[key].shape[0] for key in self.cameras)
        return channels, *self.image_size

    def choose_cameras(self) -> None:
        """Check `image_key`, and take all cameras where it is None; the others are no input any more.

        Raises:
            ValueError: There is no camera, one is unknown or repeated, or they differ in their number of channels.
        """
        known = image_keys(self.input_features)
        chosen = known if self.image_key is None else [key.strip() for key in self.image_key.split(",")]
        if not chosen or not set(chosen) <= set(known) or len(set(chosen)) < len(chosen):
            raise ValueError(
                f"--policy.image_key is {self.image_key!r}; the dataset has the cameras {', '.join(known) or 'none'}. "
                f"{self.type} sees one camera or several: set --policy.image_key to some of these, separated by "
                "commas, each once."
            )
        channels = {key: self.input_features[key].shape[0] for key in chosen}
        if len(set(channels.values())) > 1:
            raise ValueError(
                f"{self.type} sees cameras of one kind; their numbers of channels here are {channels}. Set "
                "--policy.image_key to cameras that have equally many, separated by commas."
            )
        self.image_key = ",".join(chosen)
        for key in set(known) - set(chosen):
            del self.input_features[key]


def stack_images(images: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    """Resize each camera's images (..., C, H, W) and stack them along channels: (..., K·C, *size)."""
    resized = [resize_images(image, size) for image in images]
    return resized[0] if len(resized) == 1 else torch.cat(resized, dim=-3)  # which would copy a single one


def camera_images(config: ImagePolicyConfig, batch: Mapping[str, Tensor]) -> Tensor:
    """The images of a batch as the policy sees them.

    Args:
        config: Names the cameras.
        batch: Each camera (..., C, H, W) in [0, 1].

    Returns:
        (..., K·C, H, W), the K cameras in their order.

    Raises:
        ValueError: A camera is missing.
    """
    _check_there(config, batch)
    return stack_images([batch[key] for key in config.cameras], config.image_size)


def check_observation(config: ImagePolicyConfig, batch: Mapping[str, Any]) -> None:
    """Check what a policy is shown at test time: each camera (B, C, H, W) in [0, 1], and `observation.state` (B, P).

    Raises:
        ValueError: A camera or the state is missing or has another size than in training, or images are not in [0, 1].
    """
    _check_there(config, batch)
    for key in config.cameras:
        image = batch[key]
        expected = tuple(config.input_features[key].shape)
        found = tuple(image.shape[1:])
        if found != expected:
            raise ValueError(
                f"'{key}' is {found}, this policy was trained on {expected} (C, H, W): set the camera or environment "
                f"to a height of {expected[1]} and a width of {expected[2]} (in --robot.cameras of a robot, by "
                f"--env.image_size={expected[1]} for metaworld_mt)."
            )
        if not image.is_floating_point() or image.max() > _WHITE:
            raise ValueError(
                f"'{key}' is {image.dtype} up to {image.max().item():g}; expected floating-point numbers in [0, 1]: "
                "divide a camera's bytes by 255, as prepare_observation_for_inference of lerobot.policies.utils does."
            )
    check_state(config, batch)


def check_state(config: PreTrainedConfig, batch: Mapping[str, Any]) -> None:
    """Check `observation.state` (B, P) of an observation at test time, where the policy was trained with it.

    Raises:
        ValueError: It is missing or has another size than in training.
    """
    trained_on = config.input_features.get(OBS_STATE)
    if trained_on is not None and OBS_STATE not in batch:
        raise ValueError(
            f"The observation has no '{OBS_STATE}', this policy was trained on {trained_on.shape[0]} numbers: have the "
            "robot or environment give its state (--env.obs_type=pixels_agent_pos of LeRobot's environments)."
        )
    if trained_on is not None and batch[OBS_STATE].shape[1:] != tuple(trained_on.shape):
        raise ValueError(
            f"'{OBS_STATE}' has {batch[OBS_STATE].shape[-1]} numbers, this policy was trained on "
            f"{trained_on.shape[0]}: the robot or environment is not of the kind that its dataset was recorded on."
        )


def _check_there(config: ImagePolicyConfig, batch: Mapping[str, Any]) -> None:
    for key in config.cameras:
        if key not in batch:
            shown = [name for name in batch if name.startswith(OBS_IMAGE) and not name.endswith("_is_pad")]
            raise ValueError(
                f"This policy sees '{key}'; the observation has {', '.join(shown) or 'no image'}. Add the camera to "
                "the robot or environment (--env.camera_name=corner2,topview for metaworld_mt), or give its name to "
                "one that shows the same, by --rename_map."
            )


def side_by_side(images: Tensor, n_cameras: int) -> Tensor:
    """Stacked images (..., K·C, H, W) of K cameras as one wide picture each, to be looked at: (..., C, H, K·W)."""
    return torch.cat(images.chunk(n_cameras, dim=-3), dim=-1)
