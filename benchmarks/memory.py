"""Peak memory of world-model training, and the cost of reading frames from a memory map.

    python -m benchmarks.memory --gigabytes=8 --output=memory.json

The data is a LeRobotDataset of synthetic videos: episodes of 100 frames with 64x64 pixels. --gigabytes sets the size of
the decoded frames. This needs twice that much free memory, and slightly more than that much disk space in $TMPDIR.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import BatchSampler

from benchmarks.measure import write_rows
from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.constants import FPS, OBS_IMAGE
from lerobot_wm.data.cache import CACHE_VARIABLE, cache_root
from lerobot_wm.data.loader import RamDataset
from lerobot_wm.data.schema import metaworld_features

SIZE, LENGTH, EPISODES = 64, 100, 20  # pixels, frames per episode, episodes per repeated piece
PIECE_BYTES = EPISODES * LENGTH * SIZE * SIZE * 3
BATCH, WINDOW = 16, 25
STEPS, BATCHES, REPEATS = 20, 256, 5  # training steps; batches per speed measurement; measurements
BOUND_GB = 2.5  # allowed memory of training in addition to the frames
REPO = "benchmark/memory"


def write_piece(root: Path) -> None:
    """Write a dataset of a few episodes: a disc moving over a gradient, and random numbers in all columns."""
    features = metaworld_features(SIZE, [OBS_IMAGE])
    dataset = LeRobotDataset.create(
        REPO, FPS, features, root=root, rgb_encoder=RGBEncoderConfig(vcodec="h264")
    )
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:SIZE, :SIZE]
    for episode in range(EPISODES):
        for t in range(LENGTH):
            disc = np.hypot(y - (3 * t + 7 * episode) % SIZE, x - (2 * t) % SIZE) * 4
            image = np.stack([disc, x * 4, y * 4], axis=-1).clip(0, 255).astype(np.uint8)  # (H, W, C)
            columns = {
                key: rng.integers(0, 2, feature["shape"]).astype(feature["dtype"])
                for key, feature in features.items()
                if key != OBS_IMAGE
            }
            dataset.add_frame({OBS_IMAGE: image, **columns, "task": f"task {episode % 6}"})
        dataset.save_episode()
    dataset.finalize()


def make_dataset(folder: Path, gigabytes: float) -> Path:
    """Write a LeRobotDataset whose decoded frames have about this size; return its root."""
    write_piece(folder / "piece")
    pieces = max(1, round(gigabytes * 1e9 / PIECE_BYTES))
    merge_datasets([folder / "piece"] * pieces, REPO, folder / "dataset")
    return folder / "dataset"


def training_peak(root: Path, output_dir: Path) -> dict[str, float]:
    """Measure the peak memory in GB of `lerobot-wm train --policy.type=wm_rssm`, decoding of the dataset included.

    Returns:
        `peak` includes pages of mapped files. `private` excludes them: the kernel can reclaim them, and processes
        share them.
    """
    command = [
        *(sys.executable, "-m", "lerobot_wm.cli", "train", "--policy.type=wm_rssm", "--policy.device=cpu"),
        *("--policy.push_to_hub=false", f"--policy.window_length={WINDOW}", f"--batch_size={BATCH}"),
        *(f"--steps={STEPS}", "--seed=0", "--num_workers=0", f"--output_dir={output_dir}"),
        *(f"--dataset.repo_id={REPO}", f"--dataset.root={root}"),
    ]
    process = subprocess.Popen(command, stdout=sys.stderr)
    private = 0
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        memory = psutil.Process(process.pid).memory_info()
        private = max(private, memory.rss - memory.shared)
        time.sleep(0.05)
    if status:
        raise RuntimeError(f"{' '.join(command)} failed. Its message is above.")
    return {"peak": usage.ru_maxrss * 1024 / 1e9, "private": private / 1e9}


def frames_file(root: Path) -> Path:
    """Return the file with a dataset's decoded frames."""
    [path] = cache_root(root).glob(f"frames-*/{OBS_IMAGE}.npy")
    return path


class ResidentDataset(RamDataset):
    """A RamDataset with the frames copied into the process's own memory."""

    def _fit_on_device(self) -> bool:
        return True


def windows_per_second(source: RamDataset, batches: Iterable[list[int]]) -> float:
    """Measure the speed of assembling batches of windows."""
    start = time.perf_counter()
    for rows in islice(batches, BATCHES):
        source.batch(rows)
    return BATCH * BATCHES / (time.perf_counter() - start)


def set_cached(path: Path, cached: bool) -> None:
    """Load a file into the page cache, or drop it from there (then it must not be mapped)."""
    with path.open("rb", buffering=0) as file:
        if cached:
            chunk = bytearray(1 << 24)
            while file.readinto(chunk):
                pass
        else:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def reading_speeds(root: Path) -> dict[str, list[float]]:
    """Measure windows per second from RAM, from a cached memory map, and from a memory map on disk.

    The three take turns with new memory maps, and read the same windows in the same shuffled order.
    """
    deltas = {key: [t / FPS for t in range(WINDOW)] for key in (OBS_IMAGE, "action", "next.reward")}
    dataset = LeRobotDataset(REPO, root=root, delta_timestamps=deltas, return_uint8=True)
    episodes = dataset.meta.episodes
    cpu = torch.device("cpu")
    resident = ResidentDataset(dataset, cpu)
    speeds: dict[str, list[float]] = {"RAM": [], "warm": [], "cold": []}
    for seed in range(REPEATS):
        for side in speeds:
            sampler = EpisodeAwareSampler(
                episodes["dataset_from_index"],
                episodes["dataset_to_index"],
                drop_n_last_frames=WINDOW - 1,
                shuffle=True,
                seed=seed,
            )
            set_cached(frames_file(root), cached=side != "cold")
            source = resident if side == "RAM" else RamDataset(dataset, cpu)
            speeds[side].append(windows_per_second(source, BatchSampler(sampler, BATCH, False)))
            del source  # unmaps the file
    return speeds


def measure(folder: Path, gigabytes: float) -> list[dict[str, Any]]:
    """Make the data in `folder` and measure every row."""
    root = make_dataset(folder, gigabytes)
    peak = training_peak(root, folder / "run")
    speeds = reading_speeds(root)
    data = frames_file(root).stat().st_size / 1e9
    rows: list[dict[str, Any]] = [
        {
            "row": "peak RAM, wm_rssm",
            "ours": peak["peak"],
            "peer": data + BOUND_GB,
            "peer_name": f"uint8 frames + {BOUND_GB} GB",
            "unit": "GB",
            "private": peak["private"],
        }
    ]
    for side in ("warm", "cold"):
        rows.append(
            {
                "row": f"{WINDOW}-step windows, {side} memory map",
                "ours": statistics.median(speeds[side]),
                "peer": statistics.median(speeds["RAM"]),
                "peer_name": "the same frames in RAM",
                "unit": "windows/s",
                "repeats": {key: sorted(map(round, speeds[key])) for key in (side, "RAM")},
            }
        )
    sizes = {"frames in GB": round(data, 2), "batch": BATCH, "window": WINDOW}
    return [{**row, "ratio": row["ours"] / row["peer"], "sizes": sizes} for row in rows]


def main() -> None:
    """Measure and write all rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gigabytes", type=float, default=8.0, help="size of the decoded frames")
    parser.add_argument("--output", type=Path, help="JSON file to write")
    args = parser.parse_args()
    needed, free = 2 * args.gigabytes, psutil.virtual_memory().available / 1e9
    if free < needed:
        sys.exit(
            f"--gigabytes={args.gigabytes:g} needs {needed:g} GB of free memory for the frames in the page cache and "
            f"in RAM, but {free:.1f} GB are free. Choose fewer --gigabytes."
        )
    torch.set_num_threads(1)
    os.environ.pop(CACHE_VARIABLE, None)  # cached frames are then deleted with the data
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), args.gigabytes)
    write_rows("benchmarks.memory", rows, args.output)


if __name__ == "__main__":
    main()
