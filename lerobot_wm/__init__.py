"""World-model pretraining for multi-task robot learning, as a LeRobot extension.

Importing the package registers its policy types (wm_rssm, wm_bc, wm_iql) and its environment type
(metaworld_mt) with LeRobot. Only configuration modules are imported here: a command line starts faster so.
"""

from lerobot_wm.envs import configuration as _envs  # noqa: F401
from lerobot_wm.policies.wm_bc import configuration_wm_bc as _wm_bc  # noqa: F401
from lerobot_wm.policies.wm_iql import configuration_wm_iql as _wm_iql  # noqa: F401
from lerobot_wm.policies.wm_rssm import configuration_wm_rssm as _wm_rssm  # noqa: F401

__version__ = "0.1.0"
