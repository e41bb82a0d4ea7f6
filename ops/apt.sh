# Sourced by the set-up scripts: messages, and packages from Debian's or Ubuntu's archive. No effect of its own.

say() { printf 'setup: %s\n' "$*"; }
die() {
  printf 'setup: %s\n' "$*" >&2
  exit 1
}

# Whether this user may install packages: as root, with sudo, or with sudo that may ask for a password at a terminal.
may_install() {
  command -v apt-get >/dev/null || return 1
  [ "$(id -u)" = 0 ] && return 0
  command -v sudo >/dev/null || return 1
  sudo -n true 2>/dev/null || [ -t 0 ]
}

# Run a command as root. Call may_install before.
as_root() {
  if [ "$(id -u)" = 0 ]; then
    env DEBIAN_FRONTEND=noninteractive "$@"
  else
    sudo env DEBIAN_FRONTEND=noninteractive "$@"
  fi
}

# Another set-up or the system's own update may hold the lock: wait for it rather than fail.
apt_update() { as_root apt-get -qq -o DPkg::Lock::Timeout=300 update >/dev/null; }
apt_install() { as_root apt-get -qq -o DPkg::Lock::Timeout=300 install -y --no-install-recommends "$@" >/dev/null; }
