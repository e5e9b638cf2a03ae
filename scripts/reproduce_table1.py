#!/usr/bin/env python3
"""The paper's Table 1 with controls: any arms and seeds, resumable.

    scripts/reproduce_table1.py --preset=cpu                          everything of a preset
    scripts/reproduce_table1.py --preset=cpu --arms=wm_bc,wm_iql      some arms
    scripts/reproduce_table1.py --preset=cpu --list                   what is finished and what is left

Sizes and training settings are in configs/<preset>.json. If lerobot_wm is not installed for this Python, the script
sets up the project's own .venv and uses it.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Run the experiment from the repository's root, with a Python that has lerobot_wm."""
    os.chdir(ROOT)
    if importlib.util.find_spec("lerobot_wm") is None:
        subprocess.run(["bash", "scripts/setup.sh"], check=True)
        python = str(ROOT / ".venv" / "bin" / "python")
        os.execv(python, [python, __file__, *sys.argv[1:]])
    from lerobot_wm.experiment.experiment import main as reproduce

    reproduce()


if __name__ == "__main__":
    main()
