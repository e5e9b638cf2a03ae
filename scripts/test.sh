#!/usr/bin/env bash
# Sets everything up, then checks style and runs the tests.
#
#   scripts/test.sh               style and the default tests
#   scripts/test.sh --extended    the extended tests: faults, kills, the Hub, several processes, a browser
#   scripts/test.sh ARGUMENTS     pytest with these arguments, such as tests/envs or -m slow tests/extended
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# Without bytecode files, which this variable forbids, each command spends 7 s more on its imports.
unset PYTHONDONTWRITEBYTECODE
bash scripts/setup.sh

status=0
if [[ $# -eq 0 ]]; then
  .venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy || status=$?
  # Arguments that a docstring names and a function lacks: a rule that ruff calls a preview.
  .venv/bin/ruff check --preview --select DOC102 lerobot_wm || status=$?
  set -- tests --ignore=tests/extended
elif [[ "$1" == --extended ]]; then
  set -- tests/extended "${@:2}"
fi
# Files side by side, one thread each: two threads per process on two cores wait for each other.
HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 MUJOCO_GL="${MUJOCO_GL:-egl}" \
  .venv/bin/python -m pytest -n auto --maxprocesses=4 --dist=loadfile "$@"
exit "$status"
