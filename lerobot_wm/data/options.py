"""The dataset a command reads, as flags."""

from dataclasses import dataclass

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.check import check_dataset, damage_named
from lerobot_wm.data.tables import check_finite_dataset
from lerobot_wm.hub.errors import check_dataset_version


@dataclass
class SourceConfig:
    """`--dataset.repo_id`, `--dataset.root`, `--dataset.revision` as in `lerobot-train`."""

    repo_id: str
    root: str | None = None
    revision: str | None = None

    def metadata(self) -> LeRobotDatasetMetadata:
        """What is known of the dataset without its frames; downloaded where it is not on this machine.

        Raises:
            DatasetError: It is not whole.
            HubRefusalError: It is to be downloaded, and has no such version.
        """
        self._check()
        with damage_named(self.repo_id, self.root, self.revision):
            return LeRobotDatasetMetadata(self.repo_id, root=self.root, revision=self.revision)

    def open(self) -> LeRobotDataset:
        """The dataset, all of its episodes; downloaded where it is not on this machine.

        Raises:
            DatasetError: It is not whole, or an observation, action or reward is not finite.
            HubRefusalError: It is to be downloaded, and has no such version.
        """
        self._check()
        with damage_named(self.repo_id, self.root, self.revision):
            dataset = LeRobotDataset(self.repo_id, root=self.root, revision=self.revision)
        check_finite_dataset(dataset)
        return dataset

    def _check(self) -> None:
        check_dataset(self.repo_id, self.root, self.revision)
        check_dataset_version(self.repo_id, self.root, self.revision)
