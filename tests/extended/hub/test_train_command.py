"""The command on a card is read, flag by flag, as the run that it tells of."""

import json
import shlex
from copy import deepcopy
from pathlib import Path

import draccus
import pytest
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.configs.default import DatasetConfig, PeftConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.transforms import ImageTransformConfig, ImageTransformsConfig
from lerobot.utils.sample_weighting import SampleWeightingConfig

from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.policies.common.card import train_command
from lerobot_wm.policies.common.iql import IQLConfig
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig

TASKS = ["a | b", 'it\'s "quoted"']


def test_the_command_trains_the_same_and_tells_no_place(tmp_path: Path) -> None:
    policy = WMBCConfig(
        device="cpu", world_model_path=str(tmp_path), dropout=0.3, hidden_dims=[64], tasks=TASKS
    )
    policy.world_model_fingerprint, policy.repo_id = "abc", "user/wm_bc"
    run = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="user/latents", root=str(tmp_path), revision="v1"),
        policy=policy,
        output_dir=tmp_path,
        batch_size=7,
        steps=11,
        seed=5,
    )
    command = train_command(run, None)
    assert command == (
        f"lerobot-wm train --policy.type=wm_bc --policy.dtype={policy.dtype} '--policy.hidden_dims=[64]' "
        "--policy.dropout=0.3 --policy.world_model_path=WORLD_MODEL --dataset.repo_id=user/latents "
        "--dataset.revision=v1 --seed=5 --batch_size=7 --steps=11 --policy.push_to_hub=false"
    )
    source = LatentRecord("abc", "user/images", "def", TASKS, False)
    assert "--dataset.repo_id=user/images --seed" in train_command(run, source)
    for path in ("/home/me/wm", "runs/wm/checkpoints/last/pretrained_model"):  # of another machine
        policy.world_model_path = path
        assert train_command(run, None) == command
    policy.world_model_path = "user/wm@v1"
    assert "--policy.world_model_path=user/wm@v1" in train_command(run, None)


def parsed(command: str, monkeypatch: pytest.MonkeyPatch) -> TrainPipelineConfig:
    """The configuration that `lerobot-wm train` makes of a command."""
    _, _, *flags = shlex.split(command)
    monkeypatch.setattr("sys.argv", ["lerobot-wm", *flags])
    own = [flag for flag in flags if "--policy.path=" in command and flag.startswith("--policy.")]
    run = draccus.parse(TrainPipelineConfig, args=[flag for flag in flags if flag not in own])
    run.validate()
    return run


# Where a run works, is noted and published, and how it is evaluated on the way.
OTHERS_OWN = {
    "dataset": {"root", "video_backend"},
    "policy": {
        "device",
        "push_to_hub",
        "repo_id",
        "tags",
        "pretrained_path",
        "input_features",
        "output_features",
    },
    "": {
        "output_dir",
        "job_name",
        "num_workers",
        "log_freq",
        "save_freq",
        "wandb",
        "env",
        "env_eval_freq",
        "eval",
    },
}


def what_matters(run: TrainPipelineConfig) -> dict:
    settings = run.to_dict()
    for part, names in OTHERS_OWN.items():
        for name in names:
            (settings[part] if part else settings).pop(name)
    return settings


PEFT = PeftConfig(target_modules=["a", "b"], r=4)
UNUSUAL_RUNS = {
    "defaults": {},
    "data": {
        "dataset": DatasetConfig(
            repo_id="user/x",
            root="/home/me/x",
            revision="0012",
            episodes=[0, 2],
            eval_split=0.25,
            use_imagenet_stats=False,
            image_transforms=ImageTransformsConfig(
                enable=True,
                tfs={"blur": ImageTransformConfig(type="GaussianBlur", kwargs={"kernel_size": [3, 5]})},
            ),
        ),
        "eval_steps": 10,
        "max_eval_samples": 5,
        "tolerance_s": 1e-3,
    },
    "run": {"seed": None, "cudnn_deterministic": True, "num_workers": 0, "log_freq": 1, "save_freq": 3},
    "optimizer": {
        "use_policy_training_preset": False,
        "optimizer": AdamWConfig(lr=1e-5, betas=(0.8, 0.95)),
        "scheduler": CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=5, num_decay_steps=50, peak_lr=1e-5, decay_lr=1e-9
        ),
    },
    "weights": {
        "sample_weighting": SampleWeightingConfig(kappa=1e-9, extra_params={"x": [1, None]}),
        "peft": PEFT,
    },
    "elsewhere": {
        "env": MetaworldMTEnvConfig(task="reach-v3"),
        "output_dir": Path("/home/me/run"),
        "job_name": "me",
    },
}
UNUSUAL_POLICIES = {
    "wm_rssm": WMRSSMConfig(
        device="cpu",
        dtype="bfloat16",
        image_key="observation.image",
        lr_decay_share=0.2,
        compile_model=True,
        reward_key="next.success",
        rssm=RSSMConfig(free_nats=1e-9, predict_reward=False, action_dim=4, image_channels=3),
    ),
    "wm_bc": WMBCConfig(
        device="cpu",
        dtype="float32",
        world_model_path="user/wm",
        tasks=TASKS,
        hidden_dims=[],
    ),
    "wm_iql": WMIQLConfig(
        device="cpu", use_latent=False, iql=IQLConfig(sweep_betas=[0.0, 3], done_key="null")
    ),
    "e2e_bc": E2EBCConfig(
        device="cpu",
        use_amp=True,
        normalization_mapping={"STATE": NormalizationMode.IDENTITY},
        image_key="a,b",
        encoder_image_size=(64, 48),
    ),
}


@pytest.mark.parametrize("policy", UNUSUAL_POLICIES)
@pytest.mark.parametrize("run", UNUSUAL_RUNS)
def test_the_command_is_read_as_the_run_that_was(
    run: str, policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"dataset": DatasetConfig(repo_id="user/x")} | UNUSUAL_RUNS[run]
    config = deepcopy(UNUSUAL_POLICIES[policy])
    config.repo_id = "me/private"
    before = TrainPipelineConfig(policy=config, **settings)
    monkeypatch.setattr("sys.argv", ["lerobot-wm"])
    before.validate()
    before.save_pretrained(tmp_path)
    saved = TrainPipelineConfig.from_pretrained(tmp_path)
    command = train_command(saved, None)
    assert "/home/me" not in command
    assert "me/private" not in command
    again = parsed(command, monkeypatch)
    # Filled in when the policy is made.
    if policy == "wm_rssm":
        again.policy.rssm.action_dim, again.policy.rssm.image_channels = 4, 3
    if policy == "wm_bc":
        again.policy.tasks = TASKS
    assert what_matters(again) == what_matters(saved)


def test_the_command_trains_a_checkpoint_on_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = WMBCConfig(device="cpu", push_to_hub=False, world_model_path="user/wm", dropout=0.3, lr=1.0)
    policy.save_pretrained(tmp_path)
    policy.dropout, policy.pretrained_path = 0.1, tmp_path  # the type's default, not the checkpoint's
    run = TrainPipelineConfig(dataset=DatasetConfig(repo_id="user/x"), policy=policy)
    command = train_command(run, None)
    assert command.startswith(
        "lerobot-wm train --policy.path=CHECKPOINT --policy.dropout=0.1 --dataset.repo_id="
    )
    again = parsed(command.replace("CHECKPOINT", str(tmp_path)), monkeypatch)
    assert draccus.encode(again.policy) == draccus.encode(policy)
    policy.pretrained_path = Path("/gone")  # then nobody knows what it held
    command = train_command(run, None)
    assert command.startswith("lerobot-wm train --policy.path=CHECKPOINT ")
    assert {"--policy.dropout=0.1", "--policy.lr=1.0"} <= set(shlex.split(command))
    assert "world_model_path" not in command  # only its own would be taken
    run.resume = True
    assert train_command(run, None).startswith("lerobot-wm train --policy.type=wm_bc ")


def test_the_command_chooses_the_same_cameras(tmp_path: Path) -> None:
    front, wrist = "observation.images.front", "observation.images.wrist"
    policy = WMRSSMConfig(device="cpu", image_key=f"{front},{wrist}")
    policy.input_features = {key: PolicyFeature(FeatureType.VISUAL, (3, 8, 8)) for key in (front, wrist)}
    run = TrainPipelineConfig(dataset=DatasetConfig(repo_id="user/x"), policy=policy, output_dir=tmp_path)
    assert "rename_map" not in train_command(run, None)
    for chosen in (wrist, f"{wrist},{front}", f"{front},{wrist}"):
        policy.image_key = chosen
        assert f" --policy.image_key={chosen} " in train_command(run, None)
    run.rename_map = {"observation.images.top": front}
    [flag] = [word for word in shlex.split(train_command(run, None)) if "rename_map" in word]
    assert json.loads(flag.removeprefix("--rename_map=")) == run.rename_map
