"""Command-line flags that many tests share."""

DATASET_FLAGS = "--dataset.repo_id=test/demos --dataset.root={root}"
TRAIN_FLAGS = "--policy.push_to_hub=false --policy.device=cpu --seed=0 --num_workers=0"
SMALL_WORLD_MODEL = "--policy.rssm.deter_dim=16 --policy.rssm.stoch_dim=8 --policy.rssm.hidden_dim=16"
