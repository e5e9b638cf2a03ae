from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class
from safetensors.torch import load_file, save_file

from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.policies.common.checks import check_fit
from lerobot_wm.policies.common.iql import IQLConfig
from lerobot_wm.policies.e2e.config import E2EConfig
from lerobot_wm.policies.e2e.policy import E2EPolicy
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.policies.e2e_bc.modeling_e2e_bc import E2EBCPolicy
from lerobot_wm.policies.e2e_iql.configuration_e2e_iql import E2EIQLConfig
from lerobot_wm.policies.e2e_iql.modeling_e2e_iql import E2EIQLPolicy
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

POLICY_TYPES = ("e2e_bc", "e2e_iql")
CAMERA, STATE = "observation.image", "observation.state"
TASKS = ["Reach", "Push"]
STATS = {
    STATE: {"mean": [0.5] * 4, "std": [2.0] * 4},
    "action": {"min": [-1.0, -2.0], "max": [1.0, 4.0]},
}


def make_config(
    policy_type: str, image_shape: tuple[int, int, int] = (3, 16, 20), **options: Any
) -> E2EConfig:
    features = {
        CAMERA: PolicyFeature(FeatureType.VISUAL, image_shape),
        STATE: PolicyFeature(FeatureType.STATE, (4,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (39,)),
    }
    config_class = {"e2e_bc": E2EBCConfig, "e2e_iql": E2EIQLConfig}[policy_type]
    return config_class(
        **{"device": "cpu", "tasks": list(TASKS), "input_features": features, **options},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )


def make_policy(policy_type: str, **options: Any) -> E2EPolicy:
    torch.manual_seed(0)
    policy = get_policy_class(policy_type)(make_config(policy_type, **options))
    policy.state_scaling.set_standard(*map(torch.tensor, STATS[STATE].values()))
    policy.action_scaling.set_range(*map(torch.tensor, STATS["action"].values()))
    return policy


def make_batch(policy_type: str, size: int = 8) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    steps = (2,) if policy_type == "e2e_iql" else ()
    return {
        CAMERA: torch.rand(size, *steps, 3, 16, 20, generator=generator),
        STATE: torch.randn(size, *steps, 4, generator=generator),
        f"{STATE}_is_pad": torch.zeros(size, 2, dtype=torch.bool),
        "action": torch.rand(size, 2, generator=generator) * 2 - 1,
        "next.reward": torch.rand(size, 1, generator=generator),
        "next.done": torch.rand(size, 1, generator=generator) < 0.2,
        "task": [TASKS[i % 2] for i in range(size)],
    }


def seen(size: int = 3) -> dict[str, Any]:
    """What the policy is shown at test time."""
    batch = make_batch("e2e_bc", size)
    return {key: batch[key] for key in (CAMERA, STATE, "task")}


def train(policy: E2EPolicy, batches: Callable[[int], dict[str, Any]], steps: int) -> None:
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    for step in range(steps):
        loss, _ = policy(batches(step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_select_action_is_the_mean_of_what_is_trained_clipped(policy_type: str) -> None:
    policy, frames = make_policy(policy_type).eval(), seen()
    if isinstance(policy, E2EBCPolicy):  # its mean is not bounded: bring it near the clip
        torch.nn.init.ones_(policy.actor.head.bias)
    tasks = torch.eye(2)[[0, 1, 0]]
    observation = policy.observation(frames[CAMERA], frames[STATE], tasks)
    mean = policy.actor_chunk(observation)[:, 0]
    low, high = torch.tensor(STATS["action"]["min"]), torch.tensor(STATS["action"]["max"])
    expected = low + (mean.clamp(-1, 1) + 1) / 2 * (high - low)
    action = policy.select_action(frames)
    torch.testing.assert_close(action, expected)
    assert torch.equal(policy.predict_action_chunk(frames)[:, 0], action)
    if isinstance(policy, E2EBCPolicy):  # the loss is the error of that very mean
        batch = make_batch(policy_type, 3)
        error = (policy.action_scaling(batch["action"]) - mean).square().mean()
        torch.testing.assert_close(policy(batch)[0], error)


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_each_input_changes_the_action(policy_type: str) -> None:
    policy, frames = make_policy(policy_type).eval(), seen(1)
    action = policy.select_action(frames)
    for key, value in ((CAMERA, 1 - frames[CAMERA]), (STATE, frames[STATE] + 1), ("task", ["Push"])):
        assert not torch.allclose(action, policy.select_action({**frames, key: value})), key


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_every_parameter_is_trained(policy_type: str) -> None:
    policy, batch = make_policy(policy_type), make_batch(policy_type)
    policy(batch)[0].backward()
    for name, parameter in policy.named_parameters():
        assert not parameter.requires_grad or parameter.grad.abs().sum() > 0, name
    trained = {id(p) for p in policy.parameters() if p.requires_grad}
    groups = policy.get_optim_params()
    given = [p for group in groups for p in group["params"]] if policy_type == "e2e_iql" else groups
    assert {id(p) for p in given} & trained == trained
    assert len(given) == len({id(p) for p in given})


def test_the_next_image_is_read_without_gradient() -> None:
    policy, batch = make_policy("e2e_iql", dropout=0.0), make_batch("e2e_iql")
    batch[CAMERA].requires_grad_()
    policy(batch)[0].backward()
    gradient = batch[CAMERA].grad.abs().sum(dim=(0, 2, 3, 4))  # (2,) at t and t+1
    assert gradient[0] > 0
    assert gradient[1] == 0


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_learns_to_act_on_where_a_dot_is(policy_type: str) -> None:
    def frames(seed: int) -> dict[str, Any]:
        batch = make_batch(policy_type, 64)
        places = torch.randint(2, 14, (64, 2), generator=torch.Generator().manual_seed(seed))
        images = torch.zeros(64, 3, 16, 20)
        for image, (x, y) in zip(images, places.tolist(), strict=True):
            image[0, y - 1 : y + 1, x - 1 : x + 1] = 1
        action = policy.action_scaling.inverse(places / 7.5 - 1)
        repeated = images if policy_type == "e2e_bc" else images[:, None].repeat(1, 2, 1, 1, 1)
        return {**batch, CAMERA: repeated, "action": action, "images": images}

    policy = make_policy(policy_type, dropout=0.0, lr=2e-3)
    train(policy, frames, 150)
    policy.eval()
    test = frames(seed=1000)
    state = test[STATE] if policy_type == "e2e_bc" else test[STATE][:, 0]
    action = policy.select_action({CAMERA: test["images"], STATE: state, "task": test["task"]})
    error = policy.action_scaling(action) - policy.action_scaling(test["action"])
    assert error.abs().mean() < 0.1  # less than a pixel; a constant action errs by 0.4


def test_random_crops_are_for_training_only() -> None:
    policy, frames = make_policy("e2e_bc", random_crop_pad=4, dropout=0.0), seen()
    tasks = torch.eye(2)[[0, 1, 0]]
    observe = lambda: policy.observation(frames[CAMERA], frames[STATE], tasks)  # noqa: E731
    assert not torch.equal(observe(), observe())
    policy.eval()
    assert torch.equal(observe(), observe())
    plain = make_policy("e2e_bc").eval()
    assert torch.equal(policy.select_action(frames), plain.select_action(frames))


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_save_and_load(policy_type: str, tmp_path: Path) -> None:
    policy = make_policy(policy_type).eval()
    policy.save_pretrained(tmp_path)
    loaded = get_policy_class(policy_type).from_pretrained(tmp_path)
    assert torch.equal(loaded.select_action(seen()), policy.select_action(seen()))
    assert list(loaded.config.input_features) == [CAMERA, STATE]  # what it reads, and no more

    weights = load_file(tmp_path / "model.safetensors")
    del weights["encoder.embeddings.kernel"]
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"encoder\.embeddings\.kernel"):
        get_policy_class(policy_type).from_pretrained(tmp_path)


def test_beta_chooses_among_the_trained_actors(tmp_path: Path) -> None:
    policy = make_policy("e2e_iql", iql=IQLConfig(sweep_betas=[0.0, 3.0, 0.5]))
    assert isinstance(policy, E2EIQLPolicy)
    assert policy.config.iql.trained_betas == [0.5, 0.0, 3.0]
    policy.save_pretrained(tmp_path)

    def load(beta: float) -> E2EPolicy:  # as `lerobot-eval --policy.path=... --policy.iql.beta=...` does
        config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=[f"--iql.beta={beta}"])
        return E2EIQLPolicy.from_pretrained(tmp_path, config=config)

    observation = torch.randn(2, policy.observation_dim)
    for i, beta in enumerate(policy.config.iql.trained_betas):
        mean, _ = policy.agent.actors[i].eval()(observation)
        assert torch.equal(load(beta).actor_chunk(observation)[:, 0], mean)
    with pytest.raises(ValueError, match=r"beta 7; it has actors for betas 0\.5, 0, 3"):
        load(7)


def test_a_sweep_leaves_the_main_run_as_it_is() -> None:
    batch = make_batch("e2e_iql")
    weights = []
    for sweep in ([], [0.0, 3.0]):
        policy = make_policy("e2e_iql", dropout=0.0, iql=IQLConfig(sweep_betas=sweep))
        train(policy, lambda _: batch, 3)
        weights.append(policy.state_dict())
    for name, tensor in weights[0].items():
        assert torch.equal(tensor, weights[1][name]), name


def test_unknown_task_names_the_known_ones() -> None:
    policy = make_policy("e2e_bc").eval()
    with pytest.raises(ValueError, match=r"Unknown task \['Juggle'\].*Reach.*Push"):
        policy.select_action({**seen(1), "task": ["Juggle"]})
    with pytest.raises(ValueError, match=r"no 'task' strings.*Reach.*Push"):
        policy.select_action({key: value for key, value in seen(1).items() if key != "task"})


def test_one_string_is_the_task_of_all_frames() -> None:
    policy = make_policy("e2e_bc").eval()
    frames = seen(2)
    every = policy.select_action({**frames, "task": ["Push", "Push"]})
    assert torch.equal(policy.select_action({**frames, "task": "Push"}), every)


def test_one_known_task_needs_no_string() -> None:
    policy = make_policy("e2e_bc", tasks=["Reach"]).eval()
    frames = seen(2)
    assert policy.select_action({CAMERA: frames[CAMERA], STATE: frames[STATE]}).shape == (2, 2)


def test_other_image_size() -> None:
    with pytest.raises(ValueError, match=r"\(3, 96, 96\).*\(3, 16, 20\).*--env\.image_size=16"):
        make_policy("e2e_bc").select_action({**seen(1), CAMERA: torch.zeros(1, 3, 96, 96)})


def test_several_cameras_are_stacked_at_the_first_ones_size() -> None:
    features = {
        "observation.images.left": PolicyFeature(FeatureType.VISUAL, (3, 16, 20)),
        "observation.images.right": PolicyFeature(FeatureType.VISUAL, (3, 24, 24)),
        STATE: PolicyFeature(FeatureType.STATE, (4,)),
    }
    policy = make_policy("e2e_bc", input_features=dict(features)).eval()
    assert policy.config.image_shape == (6, 16, 20)
    frames = {
        "observation.images.left": torch.rand(1, 3, 16, 20),
        "observation.images.right": torch.rand(1, 3, 24, 24),
        STATE: torch.zeros(1, 4),
        "task": ["Push"],
    }
    action = policy.select_action(frames)
    for key in ("observation.images.left", "observation.images.right"):
        assert not torch.allclose(action, policy.select_action({**frames, key: 1 - frames[key]})), key
    policy.train()(frames | {"action": torch.zeros(1, 2)})[0].backward()

    chosen = make_policy("e2e_bc", input_features=dict(features), image_key="observation.images.right").eval()
    assert list(chosen.config.input_features) == ["observation.images.right", STATE]
    del frames["observation.images.left"]
    assert chosen.select_action(frames).shape == (1, 2)


def test_wrong_options() -> None:
    with pytest.raises(ValueError, match=r"encoder='vgg'.*small, keypoints, resnet18, resnet34"):
        make_config("e2e_bc", encoder="vgg")
    with pytest.raises(ValueError, match=r"random_crop_pad=-1"):
        make_config("e2e_bc", random_crop_pad=-1)
    with pytest.raises(ValueError, match=r"48x32.*encoder_image_size=\[64,64\]"):
        make_policy("e2e_bc", encoder="keypoints", encoder_image_size=(48, 32))


def test_both_training_commands(
    demos_root: Path,
    demos: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    lerobot_train_command: Callable[[str], None],
) -> None:
    """LeRobot's loader and ours give the same checkpoint, which acts on the dataset's frames."""
    # Without dropout: LeRobot's loader draws from the generator that dropout masks come from, ours does not.
    flags = (
        "--policy.type=e2e_iql --policy.iql.sweep_betas=[0,3] --policy.dtype=float32 --policy.dropout=0 "
        f"--steps=3 --batch_size=8 --log_freq=1 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)} "
        f"--output_dir={tmp_path}"
    )
    lerobot_train_command(f"{flags}/theirs")
    lerobot_wm_command(f"train {flags}/ours")
    checkpoints = [tmp_path / run / "checkpoints" / "last" / "pretrained_model" for run in ("theirs", "ours")]
    theirs, ours = (load_file(checkpoint / "model.safetensors") for checkpoint in checkpoints)
    for name, tensor in theirs.items():
        torch.testing.assert_close(ours[name], tensor, msg=name)

    policy = E2EIQLPolicy.from_pretrained(checkpoints[1])
    assert policy.config.tasks == ["Reach a goal position", "Push and close a window"]
    assert policy.config.iql.trained_betas == [0.5, 0.0, 3.0]
    item = demos[0]
    action = policy.select_action(
        {CAMERA: item[CAMERA][None], STATE: item[STATE][None], "task": [item["task"]]}
    )
    assert action.shape == (1, 4)
    assert (action.abs() <= 1 + 1e-6).all()


def test_a_policy_left_in_training_mode_acts_without_dropout_and_crops() -> None:
    policy, batch = make_policy("e2e_bc", random_crop_pad=4), seen()
    expected = policy.eval().select_action(batch)
    assert torch.equal(policy.train().select_action(batch), expected)


def test_a_policy_of_one_task_is_not_evaluated_on_another() -> None:
    """Elsewhere it does its one task whatever it is told; metaworld_mt's tasks are known before work starts."""
    config = make_config("e2e_bc", (3, 64, 64), tasks=["Reach a goal position"])
    config.validate_features()
    check_fit(config, MetaworldMTEnvConfig(task="reach-v3"))
    with pytest.raises(ValueError, match=r"Unknown task \['Open a drawer'\]"):
        check_fit(config, MetaworldMTEnvConfig(task="drawer-open-v3"))
