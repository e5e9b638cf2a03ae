"""What a training process reads and decodes, noted in files; run as a script, `lerobot-wm` that notes it."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_wm import cli
from lerobot_wm.data.cache import CameraCache
from lerobot_wm.data.loader import RamDataset


def noting(method: Callable[..., Any], path: Path) -> Callable[..., Any]:
    """The method, which first adds its argument to a file of JSON lines."""

    def noted(self: Any, argument: Any) -> Any:
        with path.open("a") as file:
            file.write(json.dumps(argument) + "\n")
        return method(self, argument)

    return noted


if __name__ == "__main__":
    notes, rank = Path(os.environ["NOTES"]), os.environ["RANK"]
    RamDataset.batch = noting(RamDataset.batch, notes / f"rows-{rank}")  # type: ignore[method-assign]
    CameraCache._decode = noting(CameraCache._decode, notes / f"decoded-{rank}")  # type: ignore[method-assign]
    cli.main()
