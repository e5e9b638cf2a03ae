"""All rows of the benchmark with their sides and three sizes."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from benchmarks.environments import OWN

Size = dict[str, float]


@dataclass(frozen=True)
class Side:
    """One of the programs that a row compares.

    Attributes:
        name: Name in the tables.
        function: `module:function`, called with a folder and the row's size.
        environment: The environment it runs in, the project's own or a peer's.
    """

    name: str
    function: str
    environment: str = OWN


@dataclass(frozen=True)
class Row:
    """A comparison.

    Attributes:
        name: Name for `--rows`.
        title: What is measured.
        unit: Unit of the values.
        ours: Our side.
        peers: The sides to compare with; may be empty.
        sizes: Three sets of arguments for the sides, in increasing order.
        scaled: The arguments that `--scale` multiplies.
        variables: Environment variables of all sides.
        less_is_better: Whether the values are durations.
    """

    name: str
    title: str
    unit: str
    ours: Side
    peers: tuple[Side, ...]
    sizes: tuple[Size, Size, Size]
    scaled: tuple[str, ...] = ("seconds",)
    variables: Mapping[str, str] = field(default_factory=dict)
    less_is_better: bool = False

    def scaled_sizes(self, scale: float) -> list[Size]:
        """Multiply the arguments in `scaled`; counts stay whole and at least 1.

        Sizes that become equal at a small scale are merged.
        """

        def scaled(name: str, value: float) -> float:
            if name not in self.scaled:
                return value
            return max(1, round(value * scale)) if isinstance(value, int) else value * scale

        sizes = [{name: scaled(name, value) for name, value in size.items()} for size in self.sizes]
        return [size for i, size in enumerate(sizes) if size not in sizes[:i]]


def _sizes(name: str, values: tuple[float, float, float], **common: float) -> tuple[Size, Size, Size]:
    """Make three sizes that differ in one argument."""
    small, middle, large = ({name: value, **common} for value in values)
    return small, middle, large


# glibc keeps freed memory instead of returning it to the system and clearing new pages in the next step.
KEEP_MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(2**30), "MALLOC_TRIM_THRESHOLD_": str(2**30)}


def _training_row(policy: str, batches: tuple[int, int, int]) -> Row:
    return Row(
        f"train_{policy}",
        f"whole command, --policy.type={policy}, start-up left out",
        "steps/s",
        Side("lerobot-wm train", f"benchmarks.sides.training:{policy}"),
        (Side("lerobot-train", f"benchmarks.sides.training:lerobot_{policy}"),),
        _sizes("batch", batches, episodes_per_task=6, workers=2, seconds=20.0),
    )


def _world_model_row(name: str, title: str, variables: Mapping[str, str]) -> Row:
    return Row(
        name,
        f"world-model training step, {title}",
        "steps/s",
        Side("lerobot_wm", "benchmarks.sides.world_model:prepare"),
        (Side("TorchRL Dreamer", "benchmarks.sides.torchrl_dreamer:prepare", "torchrl"),),
        _sizes("batch", (4, 16, 64), length=25, seconds=10.0),
        variables=variables,
    )


def _update_row(name: str, title: str) -> Row:
    return Row(
        f"{name}_update",
        f"{title} update, 522-d observations",
        "updates/s",
        Side("lerobot_wm", f"benchmarks.sides.agents:{name}"),
        (
            Side("TorchRL", f"benchmarks.sides.torchrl_agents:{name}", "torchrl"),
            Side("d3rlpy", f"benchmarks.sides.d3rlpy_agents:{name}", "d3rlpy"),
        ),
        _sizes("batch", (64, 256, 1024), seconds=5.0),
    )


ROWS = (
    Row(
        "windows",
        "25-step windows of 64x64 frames from a data loader",
        "windows/s",
        Side("RamLoader", "benchmarks.sides.loading:ram_windows"),
        (Side("LeRobot's DataLoader", "benchmarks.sides.loading:lerobot_windows"),),
        _sizes("episodes_per_task", (6, 24, 96), batch=16, length=25, workers=2, seconds=5.0),
        scaled=("episodes_per_task", "seconds"),
    ),
    Row(
        "latents",
        "batches of 256 latent transitions from a data loader",
        "batches/s",
        Side("RamLoader", "benchmarks.sides.loading:ram_latents"),
        (Side("LeRobot's DataLoader", "benchmarks.sides.loading:lerobot_latents"),),
        _sizes("episodes_per_task", (6, 24, 96), batch=256, workers=2, seconds=10.0),
        scaled=("episodes_per_task", "seconds"),
    ),
    _training_row("wm_rssm", (4, 16, 64)),
    _training_row("wm_iql", (64, 256, 1024)),
    _training_row("wm_bc", (64, 256, 1024)),
    _world_model_row("world_model", "the allocator's own settings", {}),
    _world_model_row("world_model_malloc", "freed memory kept", KEEP_MEMORY),
    _update_row("iql", "IQL"),
    _update_row("bc", "BC"),
    Row(
        "env_step",
        "environment steps with image, the six tasks in turn",
        "steps/s",
        Side("metaworld_mt 64x64", "benchmarks.sides.envs:ours"),
        (
            Side("LeRobot's metaworld 480x480", "benchmarks.sides.envs:lerobot"),
            Side("metaworld 64x64", "benchmarks.sides.envs:metaworld_64"),
        ),
        _sizes("processes", (1, 2, 4), seconds=6.0),
    ),
    Row(
        "latency",
        "one decision of a policy on 64x64 images",
        "ms",
        Side("wm_bc with its world model", "benchmarks.sides.latency:ours"),
        (
            Side("ACT, a decision each step", "benchmarks.sides.latency:act_closed_loop"),
            Side("ACT, a decision each 100 steps", "benchmarks.sides.latency:act_chunks"),
        ),
        _sizes("batch", (1, 4, 16), seconds=5.0),
        less_is_better=True,
    ),
    Row(
        "evaluation",
        "whole command, two tasks, rollouts of 500 steps, start-up included",
        "rollouts/min",
        Side("lerobot-wm eval, metaworld_mt", "benchmarks.sides.commands:evaluate"),
        (Side("lerobot-eval, metaworld", "benchmarks.sides.commands:lerobot_evaluate"),),
        _sizes("rollouts_per_task", (1, 2, 4), workers=2),
        scaled=("rollouts_per_task",),
    ),
    Row(
        "collection",
        "whole command, six tasks, start-up included",
        "episodes/min",
        Side("lerobot-wm collect", "benchmarks.sides.commands:collect"),
        (),
        _sizes("episodes_per_task", (1, 4, 16), workers=2),
        scaled=("episodes_per_task",),
    ),
)
