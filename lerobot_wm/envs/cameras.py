"""The cameras of Meta-World's models, and the feature keys of their images."""

import difflib

from lerobot_wm.constants import OBS_IMAGE, OBS_IMAGES

# Two cameras that Meta-World's models lack. They move with the hand but never turn, so that an offset from the
# hand is always at the same place of the image. Camera -> azimuth, elevation (degrees) and distance (m).
HAND_CAMERAS = {"hand_top": (90.0, -89.9, 0.8), "hand_side": (180.0, -15.0, 0.8)}
# Metres from the hand: ahead of it, where it works.
HAND_VIEW_CENTER = (0.0, 0.15, -0.05)
CAMERAS = ("corner2", "corner", "corner3", "topview", "behindGripper", "gripperPOV", *HAND_CAMERAS)
# Mounted upside down; their images are turned by 180 degrees.
UPSIDE_DOWN = frozenset({"corner", "corner2", "corner3"})


def parse_cameras(spec: str) -> tuple[str, ...]:
    """Turn "corner2,topview" into ("corner2", "topview").

    Raises:
        ValueError: A camera is unknown or repeated, or there is none.
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
    """The feature key of each camera: `observation.image` for one camera, `observation.images.<camera>` for several.

    LeRobot gives the same keys to an environment's `pixels`, which are an image or a dictionary of images.
    """
    if len(cameras) == 1:
        return {cameras[0]: OBS_IMAGE}
    return {camera: f"{OBS_IMAGES}.{camera}" for camera in cameras}
