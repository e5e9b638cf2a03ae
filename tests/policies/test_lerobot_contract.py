"""What LeRobot asks of every policy type, held for each of ours, on batches of LeRobot's own loader.

Names and defaults, `forward` and `select_action` that leave their batch alone, actions an environment can execute,
optimizers, saving and loading, and the numbers that fixed weights give.
"""

import inspect
import json
import re
from collections.abc import Callable
from copy import copy, deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config
from safetensors.torch import save_file
from torch.utils.data import DataLoader

from lerobot_wm.policies.common.features import image_keys
from lerobot_wm.policies.common.policy import BasePolicy
from tests.policies.golden import fill, output
from tests.recording import FRONT, WRIST, camera, record, vector

ACTING = ("wm_bc", "wm_iql", "e2e_bc", "e2e_iql")
TRAINED = ("wm_rssm", *ACTING)
TYPES = (*TRAINED, "frozen_backbone")
DATASET = "--dataset.repo_id=test/recorded --dataset.root={root}"
# Outputs of fixed weights, recorded before the code was rearranged: an entry that fails is a change of numbers.
GOLDEN = json.loads(Path(__file__).with_name("golden.json").read_text())


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    features = {
        FRONT: camera(48, 64),
        WRIST: camera(32, 32),
        "observation.state": vector(5),
        "action": vector(3),
        "next.reward": vector(1),
        "next.done": vector(1, "bool"),
    }
    return record(tmp_path_factory.mktemp("contract") / "dataset", features, [("Reach", 6), ("Push", 8)])


@pytest.fixture(scope="module")
def world_model_path(dataset: LeRobotDataset, lerobot_wm_command: Callable[..., None]) -> Path:
    folder = Path(dataset.root).parent / "world_model"
    lerobot_wm_command(
        "init --policy.type=wm_rssm --policy.device=cpu --policy.rssm.deter_dim=16 --policy.rssm.stoch_dim=8",
        f"{DATASET.format(root=dataset.root)} --output_dir={folder}",
    )
    return folder / "pretrained_model"


@pytest.fixture(scope="module")
def latents_root(
    dataset: LeRobotDataset, world_model_path: Path, lerobot_wm_command: Callable[..., None]
) -> Path:
    root = Path(dataset.root).parent / "latents"
    lerobot_wm_command(
        f"encode --world_model_path={world_model_path} --device=cpu {DATASET.format(root=dataset.root)}",
        f"--output_repo_id=test/latents --output_root={root}",
    )
    return root


Made = tuple[TrainPipelineConfig, LeRobotDataset, PreTrainedPolicy]
Make = Callable[[str], Made]


@pytest.fixture(scope="module")
def make(dataset: LeRobotDataset, world_model_path: Path, latents_root: Path) -> Make:
    """A policy of a type with its defaults, made as `lerobot-train` makes it, with its run and dataset."""

    def make_type(policy_type: str) -> Made:
        on_latents = policy_type in ("wm_bc", "wm_iql")
        options = {"world_model_path": str(world_model_path)} if on_latents else {}
        cfg = TrainPipelineConfig(
            dataset=DatasetConfig("test/recorded", root=str(latents_root if on_latents else dataset.root)),
            policy=make_policy_config(policy_type, push_to_hub=False, device="cpu", **options),
        )
        if policy_type in TRAINED:  # a frozen backbone has no optimizer, which `validate` asks for
            cfg.validate()
        torch.manual_seed(0)
        source = make_dataset(cfg)
        return cfg, source, make_policy(cfg.policy, ds_meta=source.meta)

    return make_type


def training_batch(made: Made) -> dict[str, Any]:
    """A batch of three as LeRobot's training loop hands it to `forward`."""
    _, source, policy = made
    batch = next(iter(DataLoader(source, batch_size=3, sampler=[0, 5, 7])))
    for key in source.meta.camera_keys:
        if batch[key].dtype == torch.uint8:
            batch[key] = batch[key].float() / 255
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=source.meta.stats)
    return preprocessor(batch)


def shown(dataset: LeRobotDataset) -> dict[str, Any]:
    """What an environment shows at a step of two rollouts."""
    items = [dataset[0], dataset[7]]
    keys = (FRONT, WRIST, "observation.state")
    return {**{key: torch.stack([item[key] for item in items]) for key in keys}, "task": ["Reach", "Push"]}


def assert_same(batch: dict[str, Any], before: dict[str, Any]) -> None:
    assert batch.keys() == before.keys()
    for key, value in before.items():
        same = torch.equal(batch[key], value) if isinstance(value, torch.Tensor) else batch[key] == value
        assert same, key


@pytest.mark.parametrize("policy_type", TYPES)
def test_the_factory_finds_policy_and_configuration(policy_type: str) -> None:
    policy_class, config = get_policy_class(policy_type), make_policy_config(policy_type)
    assert policy_class.name == config.type == policy_type
    assert policy_class.config_class is type(config)
    # LeRobot's factory calls it so.
    assert {"dataset_stats", "dataset_meta"} <= inspect.signature(policy_class).parameters.keys()
    assert policy_class.__init__ is BasePolicy.__init__


@pytest.mark.parametrize("policy_type", TRAINED)
@pytest.mark.parametrize("dtype", ["bf16", "float16"])
def test_an_unknown_precision_is_refused(policy_type: str, dtype: str) -> None:
    with pytest.raises(ValueError, match=f"'{dtype}'; expected 'bfloat16' or 'float32'"):
        make_policy_config(policy_type, dtype=dtype)


@pytest.mark.parametrize("policy_type", TYPES)
@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"n_obs_steps": 2}, "n_obs_steps=2: "),
        (
            {"normalization_mapping": {"ACTION": NormalizationMode.MEAN_STD}},
            "normalization_mapping={'ACTION': 'MEAN_STD'}: ",
        ),
    ],
)
def test_settings_of_other_policies_are_refused(policy_type: str, wrong: dict[str, Any], says: str) -> None:
    """They were passed over, or scaled actions twice."""
    with pytest.raises(ValueError, match=re.escape(f"--policy.{says}")):
        make_policy_config(policy_type, **wrong)


@pytest.mark.parametrize("policy_type", TRAINED)
def test_adapters_are_refused(policy_type: str, make: Make) -> None:
    """LeRobot would load their base with the tasks of the trained policy, for which it has no weights."""
    with pytest.raises(ValueError, match=f"--peft: {policy_type} takes no adapters"):
        make(policy_type)[2].wrap_with_peft(peft_cli_overrides={"target_modules": "all-linear"})


@pytest.mark.parametrize("policy_type", TRAINED)
def test_a_dataset_without_statistics_is_refused(policy_type: str, make: Make) -> None:
    """LeRobot's loop goes on without them: actions were then cut off at 1 in the dataset's units."""
    made, source, _ = make(policy_type)
    meta = copy(source.meta)
    meta.stats = None
    with pytest.raises(ValueError, match=r"has no statistics \(.*meta/stats\.json\), which scale actions"):
        make_policy(made.policy, ds_meta=meta)


@pytest.mark.parametrize("policy_type", TYPES)
def test_defaults_make_a_policy_from_features_alone(policy_type: str, make: Make) -> None:
    """Without a dataset, as when a policy is made for an environment."""
    made, _, _ = make(policy_type)
    path = {"world_model_path": made.policy.world_model_path} if policy_type in ("wm_bc", "wm_iql") else {}
    config = make_policy_config(policy_type, device="cpu", **path)
    config.input_features = deepcopy(made.policy.input_features)
    config.output_features = deepcopy(made.policy.output_features)
    policy = get_policy_class(policy_type)(config)
    assert image_keys(policy.config.input_features) == [FRONT, WRIST]


def test_a_policy_on_latents_says_that_it_needs_a_world_model(make: Make) -> None:
    made, _, _ = make("wm_bc")
    config = make_policy_config("wm_bc", device="cpu")
    config.input_features, config.output_features = made.policy.input_features, made.policy.output_features
    with pytest.raises(ValueError, match=r"needs --policy\.world_model_path"):
        get_policy_class("wm_bc")(config)


@pytest.mark.parametrize("policy_type", TRAINED)
def test_forward_gives_a_loss_and_leaves_the_batch_alone(policy_type: str, make: Make) -> None:
    made = make(policy_type)
    policy, batch = made[2].train(), training_batch(made)
    before = deepcopy(batch)
    loss, parts = policy.forward(batch)
    assert loss.shape == ()
    assert torch.isfinite(loss)
    assert all(isinstance(value, float) for value in parts.values())  # LeRobot logs nothing else
    assert_same(batch, before)


@pytest.mark.parametrize("policy_type", TRAINED)
def test_lerobots_optimizer_trains_every_learnable_parameter(policy_type: str, make: Make) -> None:
    made = make(policy_type)
    cfg, _, policy = made
    optimizer, _ = make_optimizer_and_scheduler(cfg, policy)
    batch = training_batch(made)
    if policy_type == "wm_rssm":
        policy.config.rssm.free_nats = 0  # a KL below them trains no prior
    frozen = {name: p.clone() for name, p in policy.named_parameters() if not p.requires_grad}
    learnable = {name: p.clone() for name, p in policy.named_parameters() if p.requires_grad}
    for _ in range(3):  # some have no gradient before others have moved
        policy.train().forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    now = dict(policy.named_parameters())
    assert not [name for name, before in learnable.items() if torch.equal(now[name], before)]
    assert not [name for name, before in frozen.items() if not torch.equal(now[name], before)]


@pytest.mark.parametrize("policy_type", ACTING)
def test_actions(policy_type: str, make: Make, dataset: LeRobotDataset) -> None:
    """Of the environment's shape and within the data's range, the same for the same frames; the batch stays."""
    _, _, policy = make(policy_type)
    policy.eval()
    batch = shown(dataset)
    before = deepcopy(batch)
    actions = []
    for _ in range(2):
        policy.reset()
        with torch.inference_mode():
            actions.append(
                [policy.select_action(batch) for _ in range(2)]
            )  # two steps: a memory may not reach into it
    assert_same(batch, before)
    first, second = (torch.stack(steps) for steps in actions)
    assert first.shape == (2, 2, 3)
    assert first.dtype == torch.float32
    assert torch.equal(first, second)
    low, high = (torch.as_tensor(dataset.meta.stats["action"][name]) for name in ("min", "max"))
    assert bool(((first >= low - 1e-5) & (first <= high + 1e-5)).all())
    policy.reset()
    chunk = policy.predict_action_chunk(batch)
    assert chunk.shape == (2, 1, 3)
    torch.testing.assert_close(chunk[:, 0], first[0])


@pytest.mark.parametrize("policy_type", ["wm_rssm", "frozen_backbone"])
def test_what_has_no_actions_says_so(policy_type: str, make: Make, dataset: LeRobotDataset) -> None:
    _, _, policy = make(policy_type)
    for method in (policy.select_action, policy.predict_action_chunk):
        with pytest.raises(NotImplementedError, match=r"--policy\.type=wm_bc"):
            method(shown(dataset))


@pytest.mark.parametrize("policy_type", TYPES)
def test_save_and_load(policy_type: str, make: Make, dataset: LeRobotDataset, tmp_path: Path) -> None:
    _, _, policy = make(policy_type)
    policy.eval().save_pretrained(tmp_path)
    config = deepcopy(policy.config)
    for options in ({}, {"config": config}):
        loaded = get_policy_class(policy_type).from_pretrained(tmp_path, **options)
        assert not loaded.training
        state, expected = loaded.state_dict(), policy.state_dict()
        assert state.keys() == expected.keys()
        assert all(torch.equal(state[name], tensor) for name, tensor in expected.items())
    if policy_type in ACTING:
        batch = shown(dataset)
        policy.reset()
        assert torch.equal(loaded.select_action(batch), policy.select_action(batch))


@pytest.mark.parametrize("policy_type", TYPES)
def test_fixed_weights_give_the_outputs_they_always_gave(policy_type: str, tmp_path: Path) -> None:
    golden = GOLDEN[policy_type]
    (tmp_path / "config.json").write_text(json.dumps(golden["config"]))
    weights = {name: torch.zeros(shape) for name, shape in golden["shapes"].items()}
    save_file(weights, tmp_path / "model.safetensors")
    policy = get_policy_class(policy_type).from_pretrained(tmp_path)
    fill(policy)
    torch.testing.assert_close(output(policy).flatten(), torch.tensor(golden["output"]), atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("policy_type", ACTING)
def test_an_observation_without_its_state_is_refused(
    policy_type: str, dataset: LeRobotDataset, make: Make
) -> None:
    policy = make(policy_type)[2]
    observation = shown(dataset)
    del observation["observation.state"]
    with pytest.raises(ValueError, match=r"no 'observation.state'.* 5 numbers"):
        policy.select_action(observation)
