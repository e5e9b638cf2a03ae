#!/usr/bin/env bash
# Runs the tests against another LeRobot than the locked one; scripts/setup.sh must have been run before.
#
#   scripts/check_lerobot.sh PATH [pytest arguments]     PATH is a checkout of LeRobot
#
# It is installed into .venv-lerobot, with the locked versions of everything else where it allows them. UV names the
# uv to use, PYTEST_WORKERS how many processes run tests (default: one per core, at most 4).
set -euo pipefail
shopt -s inherit_errexit
LEROBOT="$(realpath "$1")"
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONDONTWRITEBYTECODE

PYTHON="$PWD/.venv-lerobot/bin/python"
UV="${UV:-$(command -v uv || echo "$PWD/.venv/uv/bin/uv")}"
if [[ -z "${SSL_CERT_FILE:-}" && -f /etc/ssl/certs/ca-certificates.crt ]]; then
  export SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt
fi
locked="$(mktemp --suffix=.txt)"
trap 'rm -f "$locked"' EXIT
grep -v '^lerobot==' requirements.lock >"$locked"

"$UV" venv --quiet --allow-existing --python .venv/bin/python .venv-lerobot
"$UV" pip sync --quiet --python "$PYTHON" "$locked"
# LeRobot's own list of package sources is for its developers.
"$UV" pip install --quiet --no-sources --python "$PYTHON" "lerobot[training,dataset,metaworld] @ file://$LEROBOT"
# As in the lock: without FFmpeg's libraries LeRobot falls back to PyAV.
"$UV" pip uninstall --quiet --python "$PYTHON" torchcodec
"$UV" pip install --quiet --python "$PYTHON" --no-deps --no-build-isolation --editable .

version="$("$PYTHON" -c 'from importlib.metadata import version; print(version("lerobot"))')"
echo "LeRobot $version, commit $(git -C "$LEROBOT" rev-parse --short HEAD 2>/dev/null || echo unknown)"
HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 MUJOCO_GL="${MUJOCO_GL:-egl}" \
  "$PYTHON" -m pytest -n "${PYTEST_WORKERS:-auto}" --maxprocesses=4 --dist=loadfile "$@"
