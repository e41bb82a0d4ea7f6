#!/usr/bin/env bash
# Gives this machine a Vulkan driver that SAPIEN can render with, if it has none.
#
#   bash ops/setup_vulkan.sh               leaves a GPU's driver alone, else installs the software driver
#   bash ops/setup_vulkan.sh --software    installs the software driver beside a GPU's
#
# Mesa's lavapipe renders in software; SAPIEN needs VK_KHR_external_semaphore_fd, which lavapipe has from Mesa 24.3 on.
# Debian 12 carries that in its backports, Debian 13 and Ubuntu 24.04 in their main archive. Safe to run again: it does
# nothing when the driver is there.
set -euo pipefail
. "$(dirname "$0")/apt.sh"

min_mesa="24.3"
# The driver, and the libraries that the wheels of SAPIEN and OpenCV (of ManiSkill) expect of the system.
packages=(mesa-vulkan-drivers libvulkan1 libegl1 libglvnd0 libx11-6 libgl1 libglib2.0-0)
libraries=(libX11.so.6 libEGL.so.1 libGL.so.1 libglib-2.0.so.0)

case "${1:-}" in
  "" | --software) ;;
  *) die "unknown argument $1; the only one is --software" ;;
esac

# Whether a driver's manifest of this name pattern is installed.
manifest() { compgen -G "/usr/share/vulkan/icd.d/$1" || compgen -G "/usr/local/share/vulkan/icd.d/$1" || compgen -G "/etc/vulkan/icd.d/$1"; }
gpu_driver() { [ -e /dev/nvidiactl ] && manifest 'nvidia_icd*.json' >/dev/null; }
mesa_version() { dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || true; }
new_enough() { [ -n "$1" ] && dpkg --compare-versions "$1" ge "$min_mesa"; }
software_driver() {
  manifest 'lvp_icd*.json' >/dev/null || return 1
  # Without dpkg, or with a driver that dpkg does not know, its age shows only when it renders: see slotfilm doctor.
  ! command -v dpkg-query >/dev/null || [ -z "$(mesa_version)" ] || new_enough "$(mesa_version)"
}
libraries_found() {
  local known name
  known=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null) || return 0
  for name in "${libraries[@]}"; do
    case "$known" in *"$name"*) ;; *) return 1 ;; esac
  done
}

wanted=driver
if software_driver || { [ "${1:-}" != --software ] && gpu_driver; }; then
  if libraries_found; then exit 0; fi
  wanted=libraries
fi

command -v apt-get >/dev/null ||
  die "install Mesa's lavapipe Vulkan driver, version $min_mesa or newer, and libX11, libEGL, libGL and GLib with this system's package manager (the driver is often named mesa-vulkan-drivers or vulkan-swrast), then run this again"
may_install ||
  die "the simulator needs system packages that this user may not install; run as root: bash $(realpath "$0") ${1:-}"

if [ "$wanted" = libraries ]; then
  say "installing the system libraries that the simulator needs"
  apt_update && apt_install "${packages[@]:1}" || die "apt-get could not install ${packages[*]:1}; see the lines above"
  exit 0
fi

say "installing a software Vulkan driver (Mesa lavapipe, $min_mesa or newer)"
apt_update || die "apt-get update failed; check this machine's package sources"

candidate() { LC_ALL=C apt-cache policy mesa-vulkan-drivers | awk '/Candidate:/ {print $2}'; }
suites() { apt-get indextargets --format '$(CODENAME) $(SUITE) $(REPO_URI)'; }
add_backports() {
  local suite="$1" codename="$2" file=/etc/apt/sources.list.d/slotfilm-backports.sources mirror key
  # Backports live on the mirror that already serves the main archive, signed with the same key.
  mirror=$(suites | awk -v name="$codename" '$1 == name && !found {print $3; found = 1}')
  [ -n "$mirror" ] || die "no package source for $codename found; add $suite to apt's sources and run this again"
  key=/usr/share/keyrings/debian-archive-keyring.gpg
  {
    printf 'Types: deb\nURIs: %s\nSuites: %s\nComponents: main\n' "$mirror" "$suite"
    if [ -e "$key" ]; then printf 'Signed-By: %s\n' "$key"; fi
  } | as_root tee "$file" >/dev/null
  if ! apt_update; then
    as_root rm -f "$file"
    die "$mirror does not carry $suite; add a mirror that does to apt's sources and run this again"
  fi
}

from=()
if ! new_enough "$(candidate)"; then
  . /etc/os-release
  [ "${ID:-}" = debian ] && [ -n "${VERSION_CODENAME:-}" ] ||
    die "${PRETTY_NAME:-this system} offers Mesa $(candidate), and SAPIEN needs $min_mesa: use Ubuntu 24.04 or newer, or Debian 12 or newer"
  suite="$VERSION_CODENAME-backports"
  suites | awk -v suite="$suite" '$1 == suite || $2 == suite {found = 1} END {exit !found}' ||
    add_backports "$suite" "$VERSION_CODENAME"
  from=(-t "$suite")
fi
apt_install "${from[@]}" "${packages[@]}" || die "apt-get could not install mesa-vulkan-drivers; see the lines above"
new_enough "$(mesa_version)" || die "mesa-vulkan-drivers $(mesa_version) is older than $min_mesa, which SAPIEN needs"
say "mesa-vulkan-drivers $(mesa_version) installed"
