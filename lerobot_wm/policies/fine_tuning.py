"""Training that goes on from a checkpoint, on the same dataset or another one."""

from lerobot.configs import FeatureType
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.cameras import ImagePolicyConfig


def fit_to_dataset(
    config: ImagePolicyConfig, saved: ImagePolicyConfig, dataset_meta: LeRobotDatasetMetadata
) -> None:
    """Check that a checkpoint can be trained on a dataset, and have it expect the dataset's cameras.

    Actions and numbers that the policy reads need the checkpoint's sizes. Images are resized to what its networks take,
    so that cameras may have another size than before: the policy is then for cameras of this size.

    Args:
        config: The configuration to train with; changed in place. LeRobot has given it the dataset's actions.
        saved: As it is in the checkpoint.
        dataset_meta: The dataset to train on.

    Raises:
        ValueError: A size differs; names both.
    """
    features = dataset_to_policy_features(dataset_meta.features)
    # A feature that the dataset has under another name (--rename_map) is not found here, nor are a latent dataset's
    # cameras.
    for key in (*saved.features_read, ACTION):
        if key not in features:
            continue
        known = (saved.output_features if key == ACTION else saved.input_features)[key]
        found = features[key]
        if known.type is not FeatureType.VISUAL and known.shape != found.shape:
            raise ValueError(
                f"This {saved.type} was trained with '{key}' of size {known.shape[0]}, {dataset_meta.repo_id} has it "
                f"with {found.shape[0]}: train it on with data of the same robot, or train anew with "
                f"--policy.type={saved.type} in place of --policy.path."
            )
        if known.type is FeatureType.VISUAL:
            config.input_features[key] = found
