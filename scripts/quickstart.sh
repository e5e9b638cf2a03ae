#!/usr/bin/env bash
# The whole pipeline on a small machine: demonstrations, world model, latents, policies, rollouts and report. It takes 8 to
# 12 minutes on two cores. It runs scripts/reproduce_table1.py with the sizes of configs/quickstart.json: ten rollouts of
# each task, on five seen and five unseen variations.
#
# You can stop it and run it again: finished stages are skipped, training resumes from its last checkpoint. To start over,
# remove outputs/quickstart.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# This variable forbids bytecode files, without which each command needs 7 s more for its imports.
unset PYTHONDONTWRITEBYTECODE

bash scripts/setup.sh
export HF_HUB_OFFLINE=1 MUJOCO_GL="${MUJOCO_GL:-egl}"
.venv/bin/lerobot-wm doctor
.venv/bin/python scripts/reproduce_table1.py --preset=quickstart

OUT="$PWD/outputs/quickstart"
cat <<END

Finished in $((SECONDS / 60)) min $((SECONDS % 60)) s.
  page     $OUT/report/index.html
  table    $OUT/report/success.md
  records  $OUT/records.jsonl
  videos   $OUT/seed_0/eval_*/videos
END
