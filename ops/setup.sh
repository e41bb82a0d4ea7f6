#!/usr/bin/env bash
# Makes this checkout ready to use: .venv with the project and its dependencies, and a Vulkan driver.
#
#   bash ops/setup.sh           what `make setup` runs
#   bash ops/setup.sh --test    also the system programs of ops/test-packages.txt
#
# Safe to run again, and then fast: a stamp in .venv records what it was made from. Environment variables:
#   PYTHON           the Python 3.11 or 3.12 to use
#   PIP_EXTRA_ARGS   further arguments of pip install, for instance an index with another build of torch
# A .venv that already holds a torch keeps it.
set -euo pipefail
cd "$(dirname "$0")/.."
. ops/apt.sh

venv=.venv
stamp=$venv/.slotfilm-setup
log=$venv/setup.log
unset PYTHONHOME PIP_USER PIP_TARGET PIP_PREFIX

case "${1:-}" in
  "" | --test) ;;
  *) die "unknown argument $1; the only one is --test" ;;
esac

# Print why a Python does not fit; nothing if it does. Fails if it does not run at all.
objection() {
  "$1" - 2>/dev/null <<'PY'
import importlib.util, sys
if not (3, 11) <= sys.version_info[:2] <= (3, 12):
    print("is Python %d.%d" % sys.version_info[:2])
elif importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
    print("lacks venv: install the package python%d.%d-venv" % sys.version_info[:2])
PY
}

# Set `python` to the first Python that fits.
find_python() {
  local candidate why="" reason
  if [ -n "${PYTHON:-}" ]; then
    reason=$(objection "$PYTHON") || die "PYTHON=$PYTHON does not run; name a Python 3.11 or 3.12"
    [ -z "$reason" ] || die "PYTHON=$PYTHON $reason; name a Python 3.11 or 3.12 with venv"
    python=$PYTHON
    return
  fi
  for candidate in python3 python3.12 python3.11 python "${PYENV_ROOT:-${HOME:-}/.pyenv}"/versions/3.1[12].*/bin/python; do
    reason=$(objection "$candidate") || continue
    python=$candidate
    [ -n "$reason" ] || return 0
    why="$why; $candidate $reason"
  done
  die "this project needs Python 3.11 or 3.12 with venv${why}. On Debian 12 or Ubuntu 24.04: apt-get install python3 python3-venv; elsewhere install one and run: PYTHON=/path/to/python3.12 make setup"
}

# What .venv was made from: the project's declared needs, the Python, and the place (scripts in .venv name it).
fingerprint() {
  { cat pyproject.toml; pwd -P; sed -n 's/^version *= *//p' "$venv/pyvenv.cfg"; } 2>/dev/null | cksum
}
up_to_date() { [ -x "$venv/bin/python" ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$(fingerprint)" ]; }

make_venv() {
  if [ -e "$venv" ]; then
    local reason place
    # Python 3.12 exports it in a branch of its own, behind one for Cygwin.
    place=$(sed -nE 's/^ *(export )?VIRTUAL_ENV=//p' "$venv/bin/activate" 2>/dev/null | tr -d "\"'" | tail -n 1) || true
    if reason=$(objection "$venv/bin/python") && [ -z "$reason" ] && [ "$place" = "$(pwd -P)/$venv" ]; then return; fi
    [ -f "$stamp" ] || [ -f "$log" ] ||
      die "$venv is not a working virtual environment of this folder with Python 3.11 or 3.12, and not made by this script; move it away and run this again"
    say "$venv was made by another Python or in another folder; making it anew"
  fi
  find_python
  say "making $venv with $("$python" --version)"
  "$python" -m venv --clear "$venv" || die "$python could not make $venv; see the lines above"
}

# Show a long installation as one changing line on a terminal, and not at all elsewhere.
show_progress() {
  local line
  while IFS= read -r line; do
    case "$line" in
      Collecting\ * | *Downloading\ * | Installing\ * | Building\ *) [ ! -t 1 ] || printf '\r\033[K%.78s' "$line" ;;
    esac
  done
  [ ! -t 1 ] || printf '\r\033[K'
}

install_project() {
  local free_kb extra
  free_kb=$(df -Pk . | awk 'END {print $4}')
  if [ "$free_kb" -lt 8000000 ]; then say "only $((free_kb / 1000000)) GB of disk are free; a torch with CUDA needs 8"; fi
  say "installing the dependencies (a few minutes the first time; details in $log)"
  read -ra extra <<<"${PIP_EXTRA_ARGS:-}"
  if ! "$venv/bin/python" -m pip install --no-input "${extra[@]}" -e ".[dev]" 2>&1 | tee "$log" | show_progress; then
    die "pip could not install the dependencies: $(grep -a -m 1 '^ERROR' "$log" | cut -c 1-300 || true) (all of it in $log)"
  fi
  fingerprint >"$stamp"
  say "the dependencies are installed"
}

# Install packages without starting their services, now or with the machine: prometheus listens on every address.
install_without_services() {
  local policy=/usr/sbin/policy-rc.d mark="# by slotfilm's set-up" status=0 package
  # One that an earlier set-up left behind, killed on the spot, is ours as well.
  if [ ! -e "$policy" ] || grep -qxF "$mark" "$policy"; then
    trap 'as_root rm -f /usr/sbin/policy-rc.d' EXIT
    trap 'exit 130' INT TERM HUP
    printf '#!/bin/sh\n%s\nexit 101\n' "$mark" | as_root tee "$policy" >/dev/null
    as_root chmod 755 "$policy"
  fi
  apt_install "$@" || status=$?
  if grep -qxF "$mark" "$policy" 2>/dev/null; then as_root rm -f "$policy"; fi
  trap - EXIT INT TERM HUP
  for package in "$@"; do
    if [ -e "/etc/init.d/$package" ]; then as_root update-rc.d "$package" disable >/dev/null 2>&1 || true; fi
  done
  return "$status"
}

install_test_programs() {
  local program package missing=()
  while read -r program package; do
    case "$program" in "" | \#*) continue ;; esac
    command -v "$program" >/dev/null || missing+=("$package")
  done <ops/test-packages.txt
  [ ${#missing[@]} -gt 0 ] || return 0
  if may_install && apt_update && install_without_services "${missing[@]}"; then
    say "installed for the tests: ${missing[*]}"
  else
    say "the tests that need ${missing[*]} will be skipped: these packages could not be installed"
  fi
}

# One set-up at a time in a folder: a second one waits here.
if command -v flock >/dev/null; then
  exec 9<ops/setup.sh
  flock 9
fi
if ! up_to_date; then
  make_venv
  install_project
fi
bash ops/setup_vulkan.sh
if [ "${1:-}" = --test ]; then install_test_programs; fi
say "ready; $venv/bin/slotfilm doctor shows what this machine can do"
