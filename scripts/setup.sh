#!/usr/bin/env bash
# Installs exactly the packages in requirements.lock into .venv, and checks that headless rendering works.
# Called by test.sh and quickstart.sh; safe to run again (about a second when nothing has changed).
set -euo pipefail
shopt -s inherit_errexit
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# uv trusts its own list of certificates; a network with an inspecting proxy needs one from the system's list.
SYSTEM_CERTIFICATES=/etc/ssl/certs/ca-certificates.crt
if [[ -z "${SSL_CERT_FILE:-}" && -f "$SYSTEM_CERTIFICATES" ]]; then
  export SSL_CERT_FILE="$SYSTEM_CERTIFICATES"
fi

# Libraries for software rendering of MuJoCo with EGL on Debian and Ubuntu.
GL_PACKAGES=(libegl1 libopengl0 libgl1-mesa-dri)

die() {
  echo "setup: $*" >&2
  exit 1
}

# Installs Debian packages if run as root; otherwise prints the command to run, and exits.
apt_install() {
  local line="apt-get update && apt-get install -y --no-install-recommends $*"
  if [[ "$(id -u)" -ne 0 ]] || ! command -v apt-get >/dev/null; then
    die "run this as root, then this script again: $line"
  fi
  echo "setup: $line" >&2
  DEBIAN_FRONTEND=noninteractive bash -c "$line" >/dev/null
}

# Prints a Python that the locked wheels exist for. Each is run, not just looked up: a pyenv shim can be on
# PATH for a version it then refuses to start.
find_python() {
  local candidate
  for candidate in python3.12 python3.13 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[23].*/bin/python3; do
    if "$candidate" -c 'import ssl, venv' >/dev/null 2>&1; then
      echo "$candidate"
      return
    fi
  done
}

# Prints a uv that runs. Where there is none it is installed under .venv/uv: pip's --target also works with a
# Python that its distribution manages, and no other project sees it. Any Python with pip will do for this.
find_uv() {
  local candidate
  for candidate in uv "$PWD/.venv/uv/bin/uv" "$HOME/.local/bin/uv"; do
    if "$candidate" --version >/dev/null 2>&1; then
      echo "$candidate"
      return
    fi
  done
  for candidate in "$@" python3 /usr/bin/python3; do
    if "$candidate" -m pip --version >/dev/null 2>&1; then
      break
    fi
  done
  # None broke the loop: candidate is Debian's own Python, for which Debian has a pip.
  "$candidate" -m pip --version >/dev/null 2>&1 || apt_install python3-pip
  PIP_ROOT_USER_ACTION=ignore "$candidate" -m pip install --quiet --target .venv/uv uv >&2
  echo "$PWD/.venv/uv/bin/uv"
}

# The folder is part of it because the editable install points at it.
fingerprint() {
  { pwd && .venv/bin/python --version && cat requirements.lock pyproject.toml; } | sha256sum
}

install_packages() {
  local python uv
  python="$(find_python)"
  uv="$(find_uv ${python:+"$python"})"
  echo "setup: installing requirements.lock into .venv (${python:-a Python 3.12 fetched by uv})"
  # Relocatable: the commands in .venv/bin keep working when the project's folder is moved.
  "$uv" venv --quiet --allow-existing --relocatable --python "${python:-3.12}" .venv ||
    die "no usable Python: put python3.12 or python3.13 on PATH, then run this script again"
  "$uv" pip sync --quiet --python .venv/bin/python requirements.lock
  # hatchling and editables are in the lock, so the build fetches nothing of its own.
  "$uv" pip install --quiet --python .venv/bin/python --no-deps --no-build-isolation --editable .
  fingerprint >.venv/setup-fingerprint
}

render_frame() {
  MUJOCO_GL="${MUJOCO_GL:-egl}" .venv/bin/python -P lerobot_wm/commands/render_probe.py
}

install_gl() {
  echo "setup: no headless rendering here ($1)"
  apt_install "${GL_PACKAGES[@]}"
  render_frame >/dev/null || die "rendering with MUJOCO_GL=${MUJOCO_GL:-egl} still fails, for the reason above"
}

if ! [[ -x .venv/bin/python && -f .venv/setup-fingerprint && "$(<.venv/setup-fingerprint)" == "$(fingerprint)" ]]; then
  install_packages
fi
error="$(render_frame 2>&1)" || install_gl "$(tail -n 1 <<<"$error")"
