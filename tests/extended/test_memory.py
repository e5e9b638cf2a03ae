"""Memory that a training frees stays with the process."""

import ctypes
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from lerobot_wm.system import keep_freed_memory

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator")

# The block's size is above the largest that glibc keeps by itself, 32 MiB.
FREE_A_BLOCK = """
import numpy as np, psutil
from lerobot_wm.system import keep_freed_memory
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


@pytest.mark.parametrize(
    ("largest", "settings"),
    [(2**30, {-3: 2**30, -1: 2**30}), (2**25, {-3: 2**25, -1: 2**30}), (0, {})],
    ids=["glibc 2.35 or later", "before", "none"],
)
def test_memory_is_kept_only_where_blocks_can_be_large(
    largest: int, settings: dict[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """glibc before 2.35 refuses thresholds above 32 MiB; to set the other alone would fix this one at 128 KiB."""
    made: dict[int, int] = {}

    def mallopt(name: int, value: int) -> int:
        accepted = name != -3 or value <= largest
        made.update({name: value} if accepted else {})
        return int(accepted)

    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(mallopt=mallopt))
    for name in [name for name in os.environ if name.startswith("MALLOC_")]:
        monkeypatch.delenv(name)
    keep_freed_memory()
    assert made == settings
