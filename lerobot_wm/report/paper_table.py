"""Table 1 of "World Models for Multi-task Robotic Pretraining", beside which ours is put.

The paper's cells are rates of one rollout on each of 50 variations, from one training seed; it announces standard
deviations and prints none. The intervals here are Wilson's, computed from the printed rates.
"""

from dataclasses import dataclass

from lerobot_wm.constants import MT6
from lerobot_wm.report.statistics import SuccessRate

ROLLOUTS_PER_CELL = 50


@dataclass(frozen=True)
class PaperArm:
    """A column of the paper's Table 1."""

    name: str
    rates: tuple[float, ...]  # success rate on each task, in the order of MT6
    overall: float  # the "Overall Success Rate" as printed

    def cells(self) -> list[SuccessRate]:
        """The rates as counts, in the order of MT6."""
        return [SuccessRate(round(rate * ROLLOUTS_PER_CELL), ROLLOUTS_PER_CELL) for rate in self.rates]

    def all_tasks(self) -> SuccessRate:
        """The cells together, which is not always the printed overall rate."""
        return SuccessRate(sum(cell.successes for cell in self.cells()), ROLLOUTS_PER_CELL * len(MT6))


# Our arm -> the paper's.
PAPER_TABLE: dict[str, PaperArm] = {
    "e2e_iql": PaperArm("Multitask from scratch, IQL", (0.04, 0.42, 0, 0.04, 0.28, 0.08), 0.1433),
    "e2e_bc": PaperArm("Multitask from scratch, BC", (0.12, 0.7, 0.02, 0.24, 0.5, 0.4), 0.33),
    "e2e_iql_single": PaperArm("Individual, IQL", (0.14, 1, 0, 0.94, 0.42, 0.72), 0.5367),
    "e2e_bc_single": PaperArm("Individual, BC", (0.32, 0.98, 0.38, 0.26, 0.84, 0.64), 0.5733),
    "wm_iql": PaperArm("Multitask World Model, IQL", (0.2, 0.92, 0.74, 0.22, 0.96, 0.84), 0.6466),
    "wm_bc": PaperArm("Multitask World Model, BC", (0.3, 0.9, 0.82, 0.2, 1, 0.72), 0.6567),
}
ODDITIES = (
    "The paper's cells: one training seed, one rollout on each of 50 variations (v2 of the tasks, demonstrations of an "
    "MTSAC agent); no deviation is printed, the Wilson intervals are computed here from the printed rates.",
    "Individual BC: the cells average 0.57, the printed overall rate is 0.5733. The other printed rates are the means "
    "of their cells (0.6466 is cut, not rounded).",
    "The paper trains its end-to-end IQL arms on dense reward, its world-model arms on sparse 0/1 reward: the arms "
    "here named _dense match the former, the other IQL arms learn from 0/1.",
)
