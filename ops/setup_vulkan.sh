#!/usr/bin/env bash
# Gives this machine a Vulkan driver that SAPIEN can render with, if it has none.
#
# A GPU driver is left alone. Without one, Mesa's lavapipe renders in software; SAPIEN needs
# VK_KHR_external_semaphore_fd, which lavapipe has from Mesa 24.3 on. Debian 12 carries that in its backports,
# Debian 13 and Ubuntu 24.04 in their main archive. Safe to run again: it does nothing when the driver is there.
set -euo pipefail

min_mesa="24.3"

say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$*" >&2; exit 1; }

gpu_driver() {
  [ -e /dev/nvidiactl ] && ls /usr/share/vulkan/icd.d/nvidia_icd*.json /etc/vulkan/icd.d/nvidia_icd*.json >/dev/null 2>&1
}
mesa_version() { dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || true; }
new_enough() { [ -n "$1" ] && dpkg --compare-versions "$1" ge "$min_mesa"; }

if gpu_driver; then say "an NVIDIA Vulkan driver is installed; no software driver needed"; exit 0; fi
if ls /usr/share/vulkan/icd.d/lvp_icd*.json >/dev/null 2>&1; then
  if ! command -v dpkg-query >/dev/null || new_enough "$(mesa_version)"; then exit 0; fi
fi

command -v apt-get >/dev/null || die "install Mesa's lavapipe Vulkan driver, version $min_mesa or newer, with this system's package manager (often named mesa-vulkan-drivers or vulkan-swrast), then run this again"

if [ "$(id -u)" = 0 ]; then sudo=(); elif sudo -n true 2>/dev/null; then sudo=(sudo); else
  die "a software Vulkan driver is missing and this user may not install packages; run as root: bash $(realpath "$0")"
fi
root() { "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive "$@"; }

. /etc/os-release
say "installing a software Vulkan driver (Mesa lavapipe, $min_mesa or newer)"
root apt-get -qq update || die "apt-get update failed; check this machine's package sources"
from=()
candidate=$(apt-cache policy mesa-vulkan-drivers | awk '/Candidate:/ {print $2}')
if ! new_enough "$candidate"; then
  suite="${VERSION_CODENAME:-}-backports"
  [ "${ID:-}" = debian ] || die "${PRETTY_NAME:-this system} offers Mesa $candidate; SAPIEN's renderer needs $min_mesa (Ubuntu 24.04 or newer, Debian 12 or newer)"
  # Backports live on the mirror that already serves the main archive, signed with the same key.
  mirror=$(apt-get indextargets --format '$(CODENAME) $(REPO_URI)' | awk -v c="$VERSION_CODENAME" '$1 == c {print $2; exit}')
  [ -n "$mirror" ] || die "no package source for $VERSION_CODENAME found; add $suite by hand and run this again"
  printf 'Types: deb\nURIs: %s\nSuites: %s\nComponents: main\nSigned-By: /usr/share/keyrings/debian-archive-keyring.gpg\n' \
    "$mirror" "$suite" | root tee "/etc/apt/sources.list.d/slotfilm-backports.sources" >/dev/null
  root apt-get -qq update || die "the mirror does not carry $suite; add a mirror that does"
  from=(-t "$suite")
fi
root apt-get -qq install -y --no-install-recommends "${from[@]}" mesa-vulkan-drivers libvulkan1 libegl1 libglvnd0 libx11-6 >/dev/null ||
  die "apt-get could not install mesa-vulkan-drivers; see the lines above"
new_enough "$(mesa_version)" || die "mesa-vulkan-drivers $(mesa_version) is older than $min_mesa, which SAPIEN needs"
say "mesa-vulkan-drivers $(mesa_version) installed"
