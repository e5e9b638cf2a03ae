"""Memory that a training frees stays with the process."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator")

# The block's size is above the largest that glibc keeps by itself, 32 MiB.
FREE_A_BLOCK = """
import numpy as np, psutil
from lerobot_wm.pipeline.memory import keep_freed_memory
keep_freed_memory()
block = np.ones(64 << 20, dtype=np.uint8)
full = psutil.Process().memory_info().rss
del block
print((full - psutil.Process().memory_info().rss) >> 20)
"""


def given_back(**variables: str) -> int:
    """MiB of a freed block of 64 MiB that the system has back."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    command = [sys.executable, "-c", FREE_A_BLOCK]
    return int(subprocess.check_output(command, env=inherited | variables, text=True))


def test_freed_memory_is_kept() -> None:
    assert given_back() < 8


def test_the_users_own_settings_rule() -> None:
    assert given_back(MALLOC_MMAP_THRESHOLD_="131072") > 56
