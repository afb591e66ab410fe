#!/usr/bin/env bash
# Make the virtual environment (.venv, or $VENV) and see that headless GL works. Used by the Makefile.
# What needs the system's package manager is installed where that is allowed (root, or sudo without a password);
# elsewhere one line says what to install.
set -euo pipefail
cd "$(dirname "$0")/.."
venv="${VENV:-.venv}"

system_install() { # PACKAGE...: true if they are there afterwards
  command -v apt-get >/dev/null || return 1
  local as_root=()
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null && sudo -n true 2>/dev/null || return 1
    as_root=(sudo -n)
  fi
  echo "setup: installing $* with apt-get"
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@" >/dev/null 2>&1 ||
    { "${as_root[@]}" apt-get update -qq >/dev/null && "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
      apt-get install -y --no-install-recommends "$@" >/dev/null; }
}

stop() {
  echo "setup: $*" >&2
  exit 1
}

find_python() { # the first interpreter of 3.11 or newer
  local candidate
  for candidate in "${PYTHON:-}" python3.11 python3 python3.12 python3.13; do
    [ -n "$candidate" ] && command -v "$candidate" >/dev/null || continue
    "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$candidate"; return; }
  done
  return 1
}

make_venv() {
  local python version
  python="$(find_python)" || stop "no Python 3.11 or newer found; install one (Debian 12: apt-get install python3.11 python3.11-venv) or set PYTHON="
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    version="$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
    system_install "python$version-venv" && "$python" -c 'import ensurepip, venv' 2>/dev/null ||
      stop "$python cannot make virtual environments; install them with: apt-get install python$version-venv"
  fi
  [ -x "$venv/bin/python" ] || { echo "setup: making $venv with $("$python" --version)"; "$python" -m venv "$venv"; }
  # torch first and by itself: whatever comes after then keeps this build (the CPU build where the index has one)
  # and does not take another of several GB.
  echo "setup: installing torch, then the rest (two minutes the first time; far more where disk or network is slow)"
  "$venv/bin/python" -m pip install --quiet "torch==2.13.0" || stop "torch 2.13.0 could not be installed; see pip's message above"
  echo "setup: torch is there; the rest"
  "$venv/bin/python" -m pip install --quiet -e ".[dev]" || stop "the packages of pyproject.toml could not be installed; see pip's message above"
  touch "$venv/.egopose-stamp"
}

renders() { # BACKEND: true if MuJoCo makes a picture with it
  MUJOCO_GL="$1" "$venv/bin/python" - >/dev/null 2>&1 <<'PY'
import mujoco
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16)
renderer.render()
renderer.close()
PY
}

check_gl() {
  renders osmesa || renders egl && return
  system_install libosmesa6 && renders osmesa ||
    stop "no headless GL library for rendering; install it with: apt-get install libosmesa6"
}

stamp="$venv/.egopose-stamp"
if [ ! -e "$stamp" ] || [ pyproject.toml -nt "$stamp" ] || [ scripts/setup.sh -nt "$stamp" ]; then make_venv; fi
check_gl
