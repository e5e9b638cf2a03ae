# ruff: noqa: E402, F401
"""World-model pretraining for multi-task robot learning, as a LeRobot extension.

Importing the package registers its policy types (wm_rssm, frozen_backbone, wm_bc, wm_iql, e2e_bc, e2e_iql) and its
environment type (metaworld_mt) with LeRobot. Only configuration modules are imported here: a command line starts
faster so.
"""

from lerobot_wm.system import name_user

name_user()

from lerobot_wm.envs import configuration as _envs
from lerobot_wm.policies.e2e_bc import configuration_e2e_bc as _e2e_bc
from lerobot_wm.policies.e2e_iql import configuration_e2e_iql as _e2e_iql
from lerobot_wm.policies.frozen_backbone import configuration_frozen_backbone as _frozen_backbone
from lerobot_wm.policies.wm_bc import configuration_wm_bc as _wm_bc
from lerobot_wm.policies.wm_iql import configuration_wm_iql as _wm_iql
from lerobot_wm.policies.wm_rssm import configuration_wm_rssm as _wm_rssm

__version__ = "0.2.0"
