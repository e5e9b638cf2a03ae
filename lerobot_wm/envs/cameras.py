"""The cameras of Meta-World's models, and the names their images go by."""

import difflib

from lerobot_wm.constants import OBS_IMAGE, OBS_IMAGES

# Two cameras that Meta-World's models lack. They move with the hand and never turn, as if mounted on the wrist: what
# lies at one offset from the hand is always at one place of the image. Camera -> azimuth, elevation (degrees) and
# distance (m).
HAND_CAMERAS = {"hand_top": (90.0, -89.9, 0.8), "hand_side": (180.0, -15.0, 0.8)}
HAND_VIEW_CENTER = (0.0, 0.15, -0.05)  # metres from the hand: ahead of it, where its work is
CAMERAS = ("corner2", "corner", "corner3", "topview", "behindGripper", "gripperPOV", *HAND_CAMERAS)
# Mounted with their upper side down; what is drawn with them is turned by 180 degrees.
UPSIDE_DOWN = frozenset({"corner", "corner2", "corner3"})


def parse_cameras(spec: str) -> tuple[str, ...]:
    """Turn "corner2,topview" into ("corner2", "topview").

    Raises:
        ValueError: No camera, an unknown or a repeated one.
    """
    cameras = tuple(name.strip() for name in spec.split(","))
    for camera in cameras:
        if camera not in CAMERAS:
            close = difflib.get_close_matches(camera, CAMERAS, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise ValueError(
                f"camera_name is '{spec}': unknown camera '{camera}'{hint}; expected one or several of "
                f"{', '.join(CAMERAS)}, separated by commas."
            )
    if len(set(cameras)) < len(cameras):
        raise ValueError(f"camera_name is '{spec}'; expected each camera once.")
    return cameras


def image_features(cameras: tuple[str, ...]) -> dict[str, str]:
    """Camera -> feature key: `observation.image` of a single camera, `observation.images.<camera>` of several.

    These are the keys that LeRobot gives to `pixels` of an environment, an image or a dictionary of images.
    """
    if len(cameras) == 1:
        return {cameras[0]: OBS_IMAGE}
    return {camera: f"{OBS_IMAGES}.{camera}" for camera in cameras}
