"""Duration in ms of `select_action` on a batch of 64x64 images."""

from pathlib import Path

import torch
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.pretrained import PreTrainedPolicy

from benchmarks.data import input_features, output_features, wm_bc
from benchmarks.timing import Prepared, rate
from lerobot_wm.constants import IMAGE_SIZE, MT6, OBS_IMAGE, OBS_STATE, STATE_DIM, TASK
from lerobot_wm.envs.tasks import task_description


def ours(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time wm_bc, which filters an image and acts in every step."""
    return _prepared(wm_bc(IMAGE_SIZE), batch, seconds)


def act_closed_loop(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time ACT looking at every image, with the temporal ensembling of its paper."""
    return _prepared(_act(n_action_steps=1, temporal_ensemble_coeff=0.01), batch, seconds)


def act_chunks(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time ACT with LeRobot's defaults, which look at one image in 100: the mean over 100 steps."""
    return _prepared(_act(), batch, seconds, steps=100)


def _act(**settings: float) -> ACTPolicy:
    config = ACTConfig(
        device="cpu",
        push_to_hub=False,
        input_features=input_features(IMAGE_SIZE),
        output_features=output_features(),
        pretrained_backbone_weights=None,  # avoids a download
        **settings,  # type: ignore[arg-type]
    )
    return ACTPolicy(config).eval()


def _prepared(policy: PreTrainedPolicy, batch: int, seconds: float, steps: int = 1) -> Prepared:
    torch.manual_seed(0)
    frame = {
        OBS_IMAGE: torch.rand(batch, 3, IMAGE_SIZE, IMAGE_SIZE),
        OBS_STATE: torch.rand(batch, STATE_DIM),
        TASK: [task_description(MT6[i % len(MT6)]) for i in range(batch)],
    }

    @torch.inference_mode()
    def step() -> int:
        for _ in range(steps):
            policy.select_action(dict(frame))
        return steps

    policy.reset()
    step()
    return Prepared(lambda: 1000 / rate(step, seconds))
