"""The arms of the experiment: the paper's Table 1 and controls that it lacks.

Each arm is stated once, here: `report` takes its order and description, `experiment` how it is trained and rolled out.
"""

from dataclasses import dataclass, replace
from typing import Any

from lerobot_wm.constants import DENSE_REWARD

# What sets the policies apart, by the name of their training settings. Presets add sizes and rates (configs/).
TRAININGS: dict[str, dict[str, Any]] = {
    "wm_rssm": {"type": "wm_rssm"},
    "wm_bc": {"type": "wm_bc"},
    "wm_bc_single": {"type": "wm_bc"},
    # On single frames: memory recognizes demonstrations by what has happened so far.
    "joint_bc": {
        "type": "wm_bc",
        "finetune_world_model": True,
        "window_length": 1,
        "use_memory": False,
        "random_crop_pad": 4,
    },
    "wm_iql": {"type": "wm_iql"},
    "wm_iql_single": {"type": "wm_iql"},
    "e2e_bc": {"type": "e2e_bc"},
    "e2e_bc_single": {"type": "e2e_bc"},
    "e2e_iql": {"type": "e2e_iql"},
    "e2e_iql_single": {"type": "e2e_iql"},
    "proprio_bc": {"type": "wm_bc", "use_latent": False},
    "state_bc": {"type": "wm_bc", "use_latent": False, "use_environment_state": True},
}


@dataclass(frozen=True)
class Encoder:
    """What turns the demonstrations into latents.

    Args:
        name: Its folder.
        training: Key of `TRAININGS`; None leaves it untrained (`lerobot-wm init`).
        flags: Further flags of its training or of `lerobot-wm init`.
    """

    name: str
    training: str | None
    flags: tuple[str, ...] = ()


WM_RSSM = Encoder("wm_rssm", "wm_rssm")
# The variant that the paper discarded (section 3.1.1): it encodes and reconstructs proprioception beside the image.
WM_RSSM_PROPRIO = Encoder("wm_rssm_proprio", "wm_rssm", ("--policy.rssm.use_proprio=true",))
UNTRAINED_RSSM = Encoder("untrained_rssm", None, ("--policy.type=wm_rssm",))
FROZEN_BACKBONE = Encoder(
    "frozen_backbone", None, ("--policy.type=frozen_backbone", "--policy.backbone=resnet18")
)


@dataclass(frozen=True)
class Arm:
    """A method: what it learns from, how it is trained and how it is rolled out.

    Args:
        name: As in records and tables.
        description: As in the report.
        training: Key of `TRAININGS`; None for the scripted expert.
        encoder: Source of the latents that the policy reads; None for a policy on the demonstrations themselves.
        individual: One policy per task instead of one for all tasks.
        trained_as: Name of the training run whose checkpoint is rolled out; None for the arm's own name.
        train_flags: Further flags of `lerobot-wm train`.
        eval_flags: Further flags of `lerobot-wm eval`.
    """

    name: str
    description: str
    training: str | None
    encoder: Encoder | None = None
    individual: bool = False
    trained_as: str | None = None
    train_flags: tuple[str, ...] = ()
    eval_flags: tuple[str, ...] = ()

    @property
    def run(self) -> str:
        """Name of the training run whose checkpoint is rolled out."""
        return self.trained_as or self.name


# Inverse temperatures of the sweep. Their actors are trained beside that of wm_iql (beta 0.5), on the same critics.
SWEEP_BETAS = (0, 3, 10)
_SWEEP_FLAG = f"--policy.iql.sweep_betas=[{','.join(map(str, SWEEP_BETAS))}]"
# Meta-World's shaped reward. If success ended the return, it would teach the policy to put success off.
_DENSE_REWARD = (f"--policy.reward_key={DENSE_REWARD}", "--policy.iql.done_key=never")

_WM_IQL = Arm(
    "wm_iql", "IQL on latents of the world model, one policy for all tasks, β 0.5", "wm_iql", WM_RSSM
)
# Takes the place of wm_iql where an arm of the sweep runs too, so that all betas share their critics. Without the
# sweep, wm_iql trains four networks instead of seven.
WM_IQL_IN_SWEEP = replace(_WM_IQL, trained_as="wm_iql_sweep", train_flags=(_SWEEP_FLAG,))


def _in_sweep(beta: int, description: str) -> Arm:
    return replace(
        WM_IQL_IN_SWEEP,
        name=f"wm_iql_beta{beta}",
        description=description,
        eval_flags=(f"--policy.iql.beta={beta}",),
    )


# In the order of tables: the paper's arms, then the controls.
ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm("e2e_iql", "IQL end to end from images, one policy for all tasks", "e2e_iql"),
        Arm("e2e_bc", "BC end to end from images, one policy for all tasks", "e2e_bc"),
        Arm(
            "e2e_iql_single",
            "IQL end to end from images, one policy per task",
            "e2e_iql_single",
            individual=True,
        ),
        Arm(
            "e2e_bc_single",
            "BC end to end from images, one policy per task",
            "e2e_bc_single",
            individual=True,
        ),
        _WM_IQL,
        Arm("wm_bc", "BC on latents of the world model, one policy for all tasks", "wm_bc", WM_RSSM),
        Arm(
            "joint_bc",
            "BC on single images, the encoder trained along from the world model's",
            "joint_bc",
            WM_RSSM,
        ),
        # The paper's IQL from images learns from the dense reward (section 4.3).
        Arm(
            "e2e_iql_dense",
            "e2e_iql trained on the dense reward, as in the paper",
            "e2e_iql",
            train_flags=_DENSE_REWARD,
        ),
        Arm(
            "e2e_iql_single_dense",
            "e2e_iql_single trained on the dense reward, as in the paper",
            "e2e_iql_single",
            individual=True,
            train_flags=_DENSE_REWARD,
        ),
        Arm(
            "wm_iql_single",
            "IQL on latents of the shared world model, one policy per task",
            "wm_iql_single",
            WM_RSSM,
            individual=True,
        ),
        Arm(
            "wm_bc_single",
            "BC on latents of the shared world model, one policy per task",
            "wm_bc_single",
            WM_RSSM,
            individual=True,
        ),
        _in_sweep(0, "wm_iql's critics with β 0: every action weighs the same, BC by likelihood"),
        _in_sweep(3, "wm_iql's critics with β 3"),
        _in_sweep(10, "wm_iql's critics with β 10"),
        Arm(
            "wm_proprio_bc",
            "BC on latents of a world model that also reads proprioception",
            "wm_bc",
            WM_RSSM_PROPRIO,
        ),
        Arm(
            "untrained_rssm_bc",
            "BC on latents of a world model that was never trained",
            "wm_bc",
            UNTRAINED_RSSM,
        ),
        Arm(
            "frozen_bc",
            "BC on features of a frozen image backbone in place of the world model",
            "wm_bc",
            FROZEN_BACKBONE,
        ),
        Arm("proprio_bc", "blind: BC on proprioception and task id alone", "proprio_bc"),
        Arm(
            "state_bc",
            "oracle: BC on the simulator's full state",
            "state_bc",
            eval_flags=("--env.environment_state=true",),
        ),
        Arm("expert", "the scripted expert itself, without noise", None),
    )
}
