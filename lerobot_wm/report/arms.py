"""The arms of the experiment as the report knows them: their order, what each is, and which are compared."""

from collections.abc import Iterable

from lerobot_wm.report.records import Record

# In the order of tables: the paper's six (its order), then the controls.
ARMS: dict[str, str] = {
    "e2e_iql": "IQL end to end from images, one policy for all tasks",
    "e2e_bc": "BC end to end from images, one policy for all tasks",
    "e2e_iql_single": "IQL end to end from images, one policy per task",
    "e2e_bc_single": "BC end to end from images, one policy per task",
    "wm_iql": "IQL on latents of the world model, one policy for all tasks, β 0.5",
    "wm_bc": "BC on latents of the world model, one policy for all tasks",
    "e2e_iql_dense": "e2e_iql trained on the dense reward, as in the paper",
    "e2e_iql_single_dense": "e2e_iql_single trained on the dense reward, as in the paper",
    "wm_iql_single": "IQL on latents of the shared world model, one policy per task",
    "wm_bc_single": "BC on latents of the shared world model, one policy per task",
    "wm_iql_beta0": "wm_iql's critics with β 0: every action weighs the same, BC by likelihood",
    "wm_iql_beta3": "wm_iql's critics with β 3",
    "wm_iql_beta10": "wm_iql's critics with β 10",
    "wm_proprio_bc": "BC on latents of a world model that also reads proprioception",
    "untrained_rssm_bc": "BC on latents of a world model that was never trained",
    "frozen_bc": "BC on features of a frozen image backbone in place of the world model",
    "proprio_bc": "blind: BC on proprioception and task id alone",
    "state_bc": "oracle: BC on the simulator's full state",
    "expert": "the scripted expert itself, without noise",
}
# Each of these is compared with every other arm.
COMPARED_ARMS = ("wm_iql", "wm_bc")
DENSE_SUFFIX = "_dense"
# Arms of one training seed stand on one world model. Not so wm_proprio_bc, which has its own.
SHARING_WORLD_MODEL = frozenset(
    {
        "wm_iql",
        "wm_bc",
        "wm_iql_single",
        "wm_bc_single",
        "wm_iql_beta0",
        "wm_iql_beta3",
        "wm_iql_beta10",
    }
)


def by_arm(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Records by arm: arms in the order of `ARMS`, then unknown ones as they come."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(record["arm"], []).append(record)
    known = [arm for arm in ARMS if arm in found]
    return {arm: found[arm] for arm in [*known, *(arm for arm in found if arm not in ARMS)]}
