#!/usr/bin/env bash
# Sets everything up, then runs the tests. Arguments go to pytest: scripts/test.sh -m slow, scripts/test.sh tests/envs.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# Without bytecode files, which this variable forbids, each command spends 7 s more on its imports.
unset PYTHONDONTWRITEBYTECODE
bash scripts/setup.sh

lint=0
if [[ $# -eq 0 ]]; then
  .venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy || lint=$?
  # Arguments that a docstring names and a function lacks: a rule that ruff calls a preview.
  .venv/bin/ruff check --preview --select DOC102 lerobot_wm || lint=$?
fi
# Files side by side, one thread each: two threads per process on two cores wait for each other.
HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 MUJOCO_GL="${MUJOCO_GL:-egl}" \
  .venv/bin/python -m pytest -n auto --maxprocesses=4 --dist=loadfile "$@"
exit "$lint"
