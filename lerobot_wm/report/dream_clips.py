"""Dreams for the page: the last episode of some tasks as a video and a strip."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.io_utils import write_video
from tqdm import tqdm

from lerobot_wm.constants import TASK
from lerobot_wm.hub.source import SourceConfig
from lerobot_wm.policies.latent_policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.report.dream import Dreams, dream
from lerobot_wm.report.dream_figures import strip_figure, video_frames
from lerobot_wm.report.episodes import episodes_by_task, read_episodes
from lerobot_wm.report.inline import MP4, PNG, data_uri, figure_bytes
from lerobot_wm.report.open_loop import CONTEXT

MAX_DREAMS = 3  # one for each of the first tasks
MAX_FRAMES = 120  # of an episode; Meta-World's experts need fewer
VIDEO_FPS = 15  # at most: episodes of a second or two are over before anything is seen


@dataclass(frozen=True)
class DreamClip:
    """The dreams of one episode; `video` and `strip` are data URIs, `kinds` what stands beside the truth, in order."""

    task: str
    episode: int
    n_imagined: int
    kinds: list[str]
    psnr: float
    copy_psnr: float
    video: str
    strip: str


def dream_clips(
    policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig
) -> list[DreamClip]:
    """Dream of the last episode of each of the first tasks.

    A policy's own actions are dreamt of too; tasks that it does not know are left out.

    Args:
        policy: The world model, or a policy on it.
        meta: A dataset that it can read, see `check_features`.
        source: Where it is.
    """
    by_task = episodes_by_task(meta, min_length=CONTEXT + 1)
    if isinstance(policy, LatentPolicy):
        by_task = {task: episodes for task, episodes in by_task.items() if task in policy.config.tasks}
    chosen = sorted(episodes[-1] for episodes in list(by_task.values())[:MAX_DREAMS])
    if not chosen:
        return []
    episodes = read_episodes(policy, meta, source, chosen, MAX_FRAMES)
    return [
        _clip(dream(policy, episode, CONTEXT), episode[TASK], index, meta.fps)
        for index, episode in zip(tqdm(chosen, desc="Dreaming", unit="episode"), episodes, strict=True)
    ]


def write_dream(path: Path, dreams: Dreams, fps: int) -> None:
    """Write the video of dreams of a dataset that was recorded at `fps` frames per second."""
    write_video(path, video_frames(dreams), min(fps, VIDEO_FPS))


def _clip(dreams: Dreams, task: str, episode: int, fps: int) -> DreamClip:
    with TemporaryDirectory() as folder:
        path = Path(folder, "dream.mp4")
        write_dream(path, dreams, fps)
        video = path.read_bytes()
    return DreamClip(
        task=task,
        episode=episode,
        n_imagined=len(dreams.truth) - dreams.context,
        kinds=list(dreams.dreams),
        psnr=dreams.psnr(),
        copy_psnr=dreams.copy_psnr(),
        video=data_uri(video, MP4),
        strip=data_uri(figure_bytes(strip_figure(dreams), PNG), PNG),
    )
