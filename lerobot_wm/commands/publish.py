"""`lerobot-wm publish`: upload a checkpoint to the Hub in one commit, with a card that shows its results.

`--policy.push_to_hub` publishes the end of training, when there is no evaluation yet; this command adds one later.
"""

import io
from dataclasses import dataclass, replace
from pathlib import Path

import draccus
import numpy as np
from huggingface_hub import CommitOperationAdd, HfApi
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from PIL import Image

from lerobot_wm.data.source import SourceConfig, dataset_folder
from lerobot_wm.errors import check_can_push
from lerobot_wm.inspect.episodes import CheckpointConfig, check_features, load_world_model
from lerobot_wm.inspect.open_loop import CONTEXT, OpenLoop, open_loop, psnr_table
from lerobot_wm.markdown import escaped
from lerobot_wm.policies.common.card import IMAGINATION, TrainingData, model_card
from lerobot_wm.records import Record, find_records, read_records
from lerobot_wm.tables import ReportTable, markdown_table, table_by_split

# Pixels of the animation per pixel of an image.
SCALE = 2
FRAME_MS = 80
# On the last frame, before the animation starts again.
PAUSE_MS = 1000
# Of a checkpoint's folder, as LeRobot uploads them.
UPLOADED = ("*.safetensors", "*.json", "*.yaml")


def animation(results: list[OpenLoop]) -> bytes:
    """A WebP file that loops, with a column per task: truth above, and below it what the model saw and then imagines.

    A white line between the two appears when the model imagines.
    """
    columns = [_column(result) for result in results]
    frames = np.concatenate(columns, axis=2).repeat(SCALE, axis=1).repeat(SCALE, axis=2)  # (T, H, W, 3)
    pictures = [Image.fromarray(frame) for frame in frames]
    durations = [FRAME_MS] * (len(pictures) - 1) + [PAUSE_MS]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "WEBP", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=70
    )
    return buffer.getvalue()


def _column(result: OpenLoop) -> np.ndarray:
    """Frames of one task, (T, 2H + 1, W, 3) uint8: truth, a line, what the model saw and then imagines."""
    below = np.concatenate([result.truth[:CONTEXT], result.imagined])  # (T, C, H, W)
    line = np.zeros_like(below[:, :, :1])
    line[CONTEXT:] = 1
    stacked = np.concatenate([result.truth, line, below], axis=2)
    return (255 * stacked.clip(0, 1)).round().astype(np.uint8).transpose(0, 2, 3, 1)


@dataclass
class PublishConfig:
    """Flags of `lerobot-wm publish`.

    Args:
        policy: The checkpoint's folder, `.../checkpoints/last/pretrained_model`.
        repo_id: The repository, as user/name; files that are there already and have not changed are not sent again.
        records: Records of `lerobot-wm eval` of this checkpoint, for the card's table; None for no table.
        dataset: An image dataset; the card shows an episode of each task and how the world model imagines it. None for
            no animation.
        private: Make a new repository private.
    """

    policy: CheckpointConfig
    repo_id: str
    records: str | None = None
    dataset: SourceConfig | None = None
    private: bool = False


def publish(cfg: PublishConfig) -> str:
    """Upload a checkpoint and its card.

    Returns:
        The commit's URL.

    Raises:
        FileNotFoundError: The folder is not a checkpoint, or there are no records.
        ValueError: The records are of another policy, the checkpoint holds no world model, or the dataset lacks what it
            reads.
    """
    folder = Path(cfg.policy.path)
    if not (folder / TRAIN_CONFIG_NAME).is_file():
        raise FileNotFoundError(
            f"{folder} holds no {TRAIN_CONFIG_NAME}, so it is not a checkpoint of a training run. Give "
            "--policy.path=<output_dir>/checkpoints/last/pretrained_model."
        )
    config = PreTrainedConfig.from_pretrained(folder)
    run = TrainPipelineConfig.from_pretrained(folder)
    tables: list[ReportTable] = []
    if cfg.records is not None:
        records = read_records(find_records(cfg.records))
        check_records(records, config.type, run.seed)
        title = f"Results ({records[0]['arm']}, preset {records[0]['preset']})"
        tables.append(table_by_split(title, records))
    files: dict[str, Path | bytes] = {
        path.name: path for pattern in UPLOADED for path in sorted(folder.glob(pattern))
    }
    tasks = None
    if cfg.dataset is not None:
        policy = load_world_model(str(folder))
        meta = cfg.dataset.metadata()
        check_features(policy, meta)
        predictions = open_loop(policy, meta, cfg.dataset)
        if predictions:
            files[IMAGINATION] = animation(predictions)
            tasks = [prediction.task for prediction in predictions]
            tables.append(psnr_table(predictions))
    results = "".join(map(_section, tables)) or None
    card = model_card(
        config,
        cfg.repo_id,
        run,
        _training_data(run),
        results,
        tasks,
    )
    files["README.md"] = str(card).encode()
    return _upload(files, cfg.repo_id, cfg.private)


def check_records(records: list[Record], policy_type: str, seed: int | None) -> None:
    """Check that all records are of the policy that is published.

    Raises:
        ValueError: They are of several arms, of another type, or of another training seed.
    """
    found = {(record["arm"], record["policy_type"], record["seed"]) for record in records}
    if len(found) > 1 or {(policy_type, seed)} != {(kind, s) for _, kind, s in found}:
        others = "; ".join(f"arm {arm}, {kind}, training seed {s}" for arm, kind, s in sorted(found, key=str))
        raise ValueError(
            f"The records are of: {others}. This checkpoint is {policy_type} with training seed {seed}: give the "
            "records of its evaluation, under one --arm."
        )


def _section(table: ReportTable) -> str:
    """A table in Markdown, the names in it escaped."""
    rows = [(escaped(label), cells) for label, cells in table.rows]
    return markdown_table(replace(table, title=escaped(table.title), rows=rows))


def _training_data(run: TrainPipelineConfig) -> TrainingData | None:
    """The dataset that the run was trained on, if it is still on this machine."""
    root = dataset_folder(run.dataset.repo_id, run.dataset.root, run.dataset.revision, whole=True)
    if root is None:
        return None
    return TrainingData.of(LeRobotDatasetMetadata(run.dataset.repo_id, root=root))


def _upload(files: dict[str, Path | bytes], repo_id: str, private: bool) -> str:
    """Upload all files in one commit, so that nobody sees half of them."""
    api = HfApi()
    api.create_repo(repo_id, private=private, exist_ok=True)
    operations = [
        CommitOperationAdd(path_in_repo=name, path_or_fileobj=content) for name, content in files.items()
    ]
    return api.create_commit(repo_id, operations, commit_message="Publish checkpoint and card").commit_url


def main() -> None:
    """Entry point of `lerobot-wm publish`."""
    cfg = draccus.parse(PublishConfig)
    check_can_push(cfg.repo_id)
    print(f"Published: {publish(cfg)}")
