"""The module LeRobot's plug-in discovery imports: it registers the policy and environment types."""

import lerobot_wm  # noqa: F401
