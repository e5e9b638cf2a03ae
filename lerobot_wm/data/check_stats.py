"""The check of a dataset's `stats.json`."""

import numpy as np
from lerobot.datasets.utils import STATS_PATH

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.check_info import MEND, Info, one_line, read_object, shown
from lerobot_wm.data.errors import DatasetError

_RECOMPUTE = f"{MEND}, or train on a copy that lerobot-edit-dataset --operation.type=recompute_stats makes"


def check_stats(info: Info) -> None:
    """Check `meta/stats.json`: LeRobot goes on without it, and then nothing scales actions and proprioception.

    Raises:
        DatasetError: It is missing or broken, or lacks finite statistics of the action or proprioception.
    """
    path = info.root / STATS_PATH
    if not path.is_file():
        raise DatasetError(
            f"{path} is missing, which scales actions and proprioception: {_RECOMPUTE}. It has none of images: "
            "train with --dataset.use_imagenet_stats=false, or LeRobot looks for them."
        )
    stats = read_object(path)
    for name, of_feature in stats.items():
        try:
            if not isinstance(of_feature, dict):
                raise TypeError(f"expected statistics by name, found {shown(of_feature)}")
            arrays = {key: np.asarray(value, dtype=np.float64) for key, value in of_feature.items()}
        except (TypeError, ValueError, OverflowError) as error:
            raise DatasetError(
                f"{path}: the statistics of {shown(name)} are no numbers ({one_line(error)}): {MEND}."
            ) from error
        if name in (ACTION, OBS_STATE):
            size = int(np.prod(info.features[name]["shape"])) if name in info.features else 0
            for key in ("min", "max", "mean", "std"):
                if key not in arrays or arrays[key].size != size or not np.isfinite(arrays[key]).all():
                    raise DatasetError(
                        f"{path}: '{key}' of {name} is {shown(of_feature.get(key))}; expected {size} finite numbers, "
                        f"as {name} has in info.json: {_RECOMPUTE}."
                    )
    missing = [name for name in (ACTION, OBS_STATE) if name in info.features and name not in stats]
    if missing:
        raise DatasetError(
            f"{path} has no statistics of {', '.join(missing)}, which scale them: {_RECOMPUTE}."
        )
