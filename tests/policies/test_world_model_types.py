"""How a policy on latents keeps its world model's configuration, of whichever type."""

import json
from pathlib import Path
from typing import Any

import draccus
import pytest
from draccus.utils import DecodingError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_wm.constants import ACTION, OBS_IMAGE, OBS_STATE
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.config import RSSMConfig


def features() -> dict[str, Any]:
    return {
        "input_features": {
            OBS_IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (4,)),
        },
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
        "image_key": OBS_IMAGE,
        "device": "cpu",
        "push_to_hub": False,
    }


def small_rssm() -> RSSMConfig:
    return RSSMConfig(8, 4, 8, 8, image_channels=3, action_dim=2)


def world_models() -> list[WorldModelConfig]:
    rssm = WMRSSMConfig(rssm=small_rssm(), window_length=7, repo_id="user/wm", **features())
    backbone = FrozenBackboneConfig(backbone="resnet18", backbone_image_size=32, latent_dim=512, **features())
    return [rssm, backbone]


def policy_config(world_model: WorldModelConfig) -> WMBCConfig:
    return WMBCConfig(world_model=world_model, tasks=["Reach"], **features())


@pytest.mark.parametrize("world_model", world_models(), ids=lambda config: config.type)
def test_checkpoints_keep_what_the_module_is_made_from(world_model: WorldModelConfig, tmp_path: Path) -> None:
    policy_config(world_model).save_pretrained(tmp_path)
    kept = json.loads((tmp_path / "config.json").read_text())["world_model"]
    assert kept["type"] == world_model.type
    assert not {"device", "push_to_hub", "repo_id", "license", "pretrained_path"} & kept.keys()
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    expected = draccus.encode(world_model, PreTrainedConfig) | {"push_to_hub": True, "repo_id": None}
    assert draccus.encode(loaded.world_model, PreTrainedConfig) == expected
    assert loaded.latent_dim == world_model.latent_dim


def test_runs_keep_it(tmp_path: Path) -> None:
    policy = policy_config(world_models()[0])
    run = TrainPipelineConfig(dataset=DatasetConfig("test/latents"), policy=policy)
    run._save_pretrained(tmp_path)
    loaded = TrainPipelineConfig.from_pretrained(tmp_path)
    assert draccus.encode(loaded.policy) == draccus.encode(run.policy)


def test_flags_beside_a_checkpoint_leave_it_alone(tmp_path: Path) -> None:
    policy_config(world_models()[0]).save_pretrained(tmp_path)
    loaded = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--lr=0.5"])
    assert loaded.lr == 0.5
    assert loaded.world_model.rssm == small_rssm()


def test_a_world_model_of_an_unknown_type(tmp_path: Path) -> None:
    policy_config(world_models()[0]).save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace('"wm_rssm"', '"wm_unheard_of"'))
    with pytest.raises(DecodingError, match=r"(?s)wm_unheard_of.*wm_rssm.*discover_packages_path"):
        PreTrainedConfig.from_pretrained(tmp_path)


def test_a_world_model_that_reads_no_actions_serves_any_robot() -> None:
    rssm, backbone = world_models()
    for world_model in (rssm, backbone):
        config = policy_config(world_model)
        config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (7,))}
        if world_model is backbone:
            config.validate_features()
        else:
            with pytest.raises(ValueError, match=r"2-d actions.*7-d"):
                config.validate_features()


def test_a_policy_scales_the_latents_of_those_that_ask_for_it() -> None:
    for world_model in world_models():
        names = {name.split(".")[0] for name in WMBCPolicy(policy_config(world_model)).state_dict()}
        assert ("latent_scaling" in names) == world_model.scales_latents
