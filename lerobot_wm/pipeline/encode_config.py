"""Flags of `lerobot-wm encode`."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot_wm.hub.source import SourceConfig


@dataclass
class EncodeConfig:
    """Flags of `lerobot-wm encode`.

    Args:
        world_model_path: Folder or Hub id (user/name or user/name@revision) of a wm_rssm or frozen_backbone checkpoint,
            or of a policy on latents, which has its own in it.
        dataset: The image dataset.
        output_repo_id: Repository id of the latent dataset.
        output_root: Its folder; must not exist yet.
        sample: Store a sample of z_t instead of its mean.
        seed: Seed of the samples.
        rename_map: The names that the world model knows the dataset's cameras and proprioception by, where they are
            others, as in `lerobot-train`. What the latent dataset keeps of these has the dataset's own names.
        device: Where to run the world model; None picks the fastest there is.
        shard: Of several jobs, the one this is: 1/4 is the first of four. Each job encodes its share of the episodes
            into `<output_root>.parts`; when all are in one such folder, the same command without this flag makes the
            dataset of them. Where machines share a disk, set LEROBOT_WM_CACHE to a folder of its own for each: they
            must not decode frames into one file.
        push_to_hub: Upload the result as `output_repo_id`; also one that was encoded before.
        private: Upload to a private repository.
        license: Licence of the uploaded dataset, as the Hub names it; None takes what the source's card says.
    """

    world_model_path: str
    dataset: SourceConfig
    output_repo_id: str
    output_root: Path
    sample: bool = False
    seed: int = 0
    rename_map: dict[str, str] = field(default_factory=dict)
    device: str | None = None
    shard: str | None = None
    push_to_hub: bool = False
    private: bool = False
    license: str | None = None
