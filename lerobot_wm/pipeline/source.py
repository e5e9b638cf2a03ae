"""The dataset a command reads, as flags."""

from dataclasses import dataclass

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.hub.errors import check_dataset_version


@dataclass
class SourceConfig:
    """`--dataset.repo_id`, `--dataset.root`, `--dataset.revision` as in `lerobot-train`."""

    repo_id: str
    root: str | None = None
    revision: str | None = None

    def open(self) -> LeRobotDataset:
        """The dataset, all of its episodes; downloaded where it is not on this machine.

        Raises:
            HubRefusalError: It is to be downloaded, and has no such version.
        """
        check_dataset_version(self.repo_id, self.root, self.revision)
        return LeRobotDataset(self.repo_id, root=self.root, revision=self.revision)
