"""The arms of the experiment: the paper's Table 1 and the controls it lacks, as data."""

from dataclasses import dataclass, replace

SWEEP_BETAS = (0, 3, 10)  # inverse temperatures trained beside wm_iql's own 0.5, on the same critics


@dataclass(frozen=True)
class Encoder:
    """What turns the demonstrations into latents, before any policy is trained.

    Args:
        name: Its folder.
        config: Training settings `configs/<preset>/<config>.json`; None leaves it untrained (`lerobot-wm init`).
        flags: Further flags of its training or of `lerobot-wm init`.
    """

    name: str
    config: str | None
    flags: tuple[str, ...] = ()


WM_RSSM = Encoder("wm_rssm", "wm_rssm")
# The paper's discarded variant (section 3.1.1): proprioception encoded and reconstructed beside the image.
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
        config: Training settings `configs/<preset>/<config>.json`; None for the scripted expert, which has none.
        encoder: Source of the latents the policy reads; None for policies on the demonstrations themselves.
        individual: One policy per task in place of one for all.
        dense_reward: Learn from Meta-World's shaped reward in place of the sparse 0/1 one.
        trained_as: Another arm whose checkpoints this one rolls out; None for its own.
        train_flags: Further flags of `lerobot-wm train`.
        eval_flags: Further flags of `lerobot-wm eval`.
    """

    name: str
    config: str | None
    encoder: Encoder | None = None
    individual: bool = False
    dense_reward: bool = False
    trained_as: str | None = None
    train_flags: tuple[str, ...] = ()
    eval_flags: tuple[str, ...] = ()

    @property
    def training(self) -> str:
        """Name of the training whose checkpoint is rolled out."""
        return self.trained_as or self.name


_SWEEP_FLAG = f"--policy.sweep_betas=[{','.join(map(str, SWEEP_BETAS))}]"
_NO_END = ("--policy.done_key=never",)  # a dense reward that success ended would teach to put it off
_WM_IQL = Arm("wm_iql", "wm_iql", WM_RSSM)
# Rolls out in place of it where an arm of the sweep is run, too: all betas are then on the same critics. Alone it is
# spared the sweep's actors, three of the seven networks it trains.
WM_IQL_IN_SWEEP = replace(_WM_IQL, trained_as="wm_iql_sweep", train_flags=(_SWEEP_FLAG,))

# In the order of tables: the paper's arms, then the controls.
ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm("e2e_iql", "e2e_iql"),
        Arm("e2e_bc", "e2e_bc"),
        Arm("e2e_iql_single", "e2e_iql_single", individual=True),
        Arm("e2e_bc_single", "e2e_bc_single", individual=True),
        _WM_IQL,
        Arm("wm_bc", "wm_bc", WM_RSSM),
        # The paper's end-to-end and individual IQL learn from the dense reward (section 4.3).
        Arm("e2e_iql_dense", "e2e_iql", dense_reward=True, train_flags=_NO_END),
        Arm(
            "e2e_iql_single_dense", "e2e_iql_single", individual=True, dense_reward=True, train_flags=_NO_END
        ),
        Arm("wm_iql_single", "wm_iql_single", WM_RSSM, individual=True),
        Arm("wm_bc_single", "wm_bc_single", WM_RSSM, individual=True),
        *(
            replace(
                WM_IQL_IN_SWEEP,
                name=f"wm_iql_beta{beta}",
                eval_flags=(f"--policy.beta={beta}",),
            )
            for beta in SWEEP_BETAS
        ),
        Arm("wm_proprio_bc", "wm_bc", WM_RSSM_PROPRIO),
        Arm("untrained_rssm_bc", "wm_bc", UNTRAINED_RSSM),
        Arm("frozen_bc", "wm_bc", FROZEN_BACKBONE),
        Arm("proprio_bc", "proprio_bc"),
        Arm("state_bc", "state_bc", eval_flags=("--env.environment_state=true",)),
        Arm("expert", None),
    )
}
