"""Arithmetic operations of a world model's training step, and how close it runs to the machine's peak.

    python results/analysis/world_model_flops.py --output=results/analysis/world_model_flops.json

Counts matrix products and convolutions, forward and backward, for the batch of preset `cpu` (PyTorch's
FlopCounterMode: a multiply-add counts as two). The peak is the speed of a large matrix product in the same number type
on one thread; both are timed alternately.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from lerobot_wm.constants import ACTION_DIM, IMAGE_SIZE
from lerobot_wm.nn.conv import ConvDecoder, ConvEncoder
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.records import provenance
from lerobot_wm.system import keep_freed_memory
from lerobot_wm.world_model.config import RSSMConfig
from lerobot_wm.world_model.model import WorldModel

BATCH, LENGTH = 16, 25  # of preset cpu
DECODE_SHARES = (1.0, 0.6, 0.2)
MATRIX = 2048
ROUNDS = 10


def make_step(decode_share: float, dtype: torch.dtype) -> Callable[[], None]:
    """Make a function that computes loss and gradients of a default world model on random windows (B, T)."""
    torch.manual_seed(0)
    model = WorldModel(RSSMConfig(image_channels=3, action_dim=ACTION_DIM, decode_share=decode_share))
    images = torch.rand(BATCH, LENGTH, 3, IMAGE_SIZE, IMAGE_SIZE)
    actions = torch.rand(BATCH, LENGTH, ACTION_DIM) * 2 - 1
    rewards = (torch.rand(BATCH, LENGTH) < 0.1).float()
    valid = torch.ones(BATCH, LENGTH, dtype=torch.bool)

    def step() -> None:
        with torch.autocast("cpu", dtype=dtype, enabled=dtype != torch.float32):
            loss, _ = model.loss(images, actions, valid, rewards)
        loss.backward()
        model.zero_grad()

    return step


def count_gflop(decode_share: float) -> dict[str, float]:
    """Count the GFLOP of a step: total, image encoder, image decoder."""
    step = make_step(decode_share, torch.float32)
    with FlopCounterMode(display=False) as counter:
        step()
    counts = counter.get_flop_counts()
    parts = {"all": "Global", "encoder": ConvEncoder.__name__, "decoder": ConvDecoder.__name__}
    return {name: sum(counts[module].values()) / 1e9 for name, module in parts.items()}


def time_call(call: Callable[[], Any]) -> float:
    """Return the wall time of one call in seconds."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def measure_speed(gflop: float, dtype: torch.dtype) -> dict[str, float | str]:
    """Measure GFLOP/s of the step and of a matrix product on one thread; medians of alternating calls."""
    torch.set_num_threads(1)
    step = make_step(1.0, dtype)
    left, right = torch.randn(2, MATRIX, MATRIX).to(dtype)
    step(), left @ right  # warm-up
    pairs = [(time_call(step), time_call(lambda: left @ right)) for _ in range(ROUNDS)]
    of_step, of_product = (statistics.median(times) for times in zip(*pairs, strict=True))
    return {
        "dtype": str(dtype),
        "step_seconds": of_step,
        "step_gflop_per_second": gflop / of_step,
        "product_gflop_per_second": 2 * MATRIX**3 / 1e9 / of_product,
    }


def main() -> None:
    """Count, measure, write the JSON file and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    output: Path = parser.parse_args().output
    keep_freed_memory()  # as `lerobot-wm train` does
    gflop = {str(share): count_gflop(share) for share in DECODE_SHARES}
    dtype = getattr(torch, str(WMRSSMConfig(device="cpu").dtype))
    result = {
        "batch": [BATCH, LENGTH],
        "gflop_by_decode_share": gflop,
        "one_thread": measure_speed(gflop["1.0"]["all"], dtype),
        "provenance": provenance(),
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(result, indent=2) + "\n")
    print(output.read_text())


if __name__ == "__main__":
    main()
