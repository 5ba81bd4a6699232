#!/usr/bin/env bash
# Makes a checkout ready to run: Debian packages, a Python environment in .venv, pinned Python packages.
#
#   scripts/setup.sh demo       what a simulated print needs (a C compiler, numpy, matplotlib, ...)
#   scripts/setup.sh study      that, and what studies of many prints need (scripts/study.py)
#   scripts/setup.sh moonraker  demo, and Moonraker in an environment of its own
#   scripts/setup.sh test       what `make test` needs: study, Moonraker, clang, cross compilers, mypy, pytest, ...
#   scripts/setup.sh browser    what `make test-browser` needs: pytest, Moonraker and Chromium
#   scripts/setup.sh flash      what `make test-flash` needs: pytest, cross compilers, avrdude, openocd
#   scripts/setup.sh host       what the host needs on a printer (scripts/install.sh)
#   scripts/setup.sh printer    that, and Moonraker in .moonraker
#
# Safe to run again and again: what is there is left alone, and when nothing is missing it takes
# well under a second. Silent unless it installs something, waits for something or cannot.
set -euo pipefail
cd "$(dirname "$0")/.."

level=${1:-demo}
venv=.venv
min_python='(3, 11)'
lock_wait_s=300   # how long another program may keep the locks of apt ...
lock_poll_s=2     # ... how often they are tried ...
lock_notice_s=30  # ... and how often the wait is mentioned

say()  { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# package, and a file (a glob will do) or command that only it brings
demo_packages=(
  "gcc               gcc"
  "libc6-dev         /usr/include/stdio.h"
)
study_packages=("${demo_packages[@]}")
host_packages=(
  "${demo_packages[@]}"
  "python3-dev       /usr/include/python3*/Python.h"
)
moonraker_packages=(
  "${demo_packages[@]}"
  "libsodium23       /usr/lib/*/libsodium.so.23"
  "iproute2          ip"
)
printer_packages=(
  "${host_packages[@]}"
  "${moonraker_packages[@]:2}"
)
cross_packages=(
  "gcc-arm-none-eabi        arm-none-eabi-gcc"
  "libnewlib-arm-none-eabi  /usr/include/newlib/stdio.h"
  "gcc-avr                  avr-gcc"
  "avr-libc                 /usr/lib/avr/include/avr/io.h"
)
test_packages=(
  "${moonraker_packages[@]}"
  "${cross_packages[@]}"
  "clang                    clang"
  "libclang-rt-14-dev       /usr/lib/llvm-*/lib/clang/*/lib/linux/libclang_rt.fuzzer-*.a"
  "cppcheck                 cppcheck"
  "libsimavr-dev            /usr/include/simavr/sim_avr.h"
)
browser_packages=(
  "${moonraker_packages[@]}"
  "chromium          chromium"
)
flash_packages=(
  "${demo_packages[@]}"
  "${cross_packages[@]}"
  "avrdude           avrdude"
  "openocd           openocd"
)

present() { # probe: true if the command is on PATH or the glob matches a file
  case $1 in
    /*) compgen -G "$1" >/dev/null ;;
    *)  command -v "$1" >/dev/null ;;
  esac
}

missing_packages() { # lines "package probe" -> names of the packages whose probe finds nothing
  local package probe
  for line in "$@"; do
    read -r package probe <<<"$line"
    present "$probe" || printf '%s ' "$package"
  done
}

quietly() { # runs a command; shows what it printed only if it fails
  local log status=0
  log=$(mktemp)
  "$@" >"$log" 2>&1 || status=$?
  [ "$status" -eq 0 ] || cat "$log" >&2
  rm -f "$log"
  return "$status"
}

# On a printer the person in front of it may be asked for a password; a build asks nobody.
sudo=(sudo -n)
if [[ $level = @(host|printer) ]] && [ -t 0 ]; then sudo=(sudo); fi

as_root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"; else "${sudo[@]}" "$@"; fi
}

may_be_root() {
  [ "$(id -u)" -eq 0 ] || { command -v sudo >/dev/null && "${sudo[@]}" true; }
}

waited_s=0
apt_get() { # runs apt-get, waiting while another program holds one of apt's locks; shows what it printed if it fails
  # apt's own DPkg::Lock::Timeout does not cover the locks of the package lists and of the archive
  local log status held
  log=$(mktemp)
  while true; do
    status=0
    as_root env LC_ALL=C DEBIAN_FRONTEND=noninteractive apt-get "$@" >"$log" 2>&1 9>&- || status=$?
    held=$(grep -m 1 -E 'Could not get lock|locked by another process' "$log") || break
    [ "$status" -ne 0 ] || break
    if [ "$waited_s" -ge "$lock_wait_s" ]; then
      rm -f "$log"
      fail "another program has held apt's lock for $lock_wait_s s (${held#E: }); run this again when it has ended"
    fi
    if [ $((waited_s % lock_notice_s)) -eq 0 ]; then
      say "waiting for another program to release apt's lock, $waited_s of at most $lock_wait_s s (${held#E: })"
    fi
    sleep "$lock_poll_s"
    waited_s=$((waited_s + lock_poll_s))
  done
  [ "$status" -eq 0 ] || cat "$log" >&2
  rm -f "$log"
  return "$status"
}

install_debian() { # package names
  local command="apt-get install $*"
  command -v apt-get >/dev/null || fail "this is not a Debian system; install what these packages hold: $*"
  if [ "$(id -u)" -ne 0 ] && ! command -v sudo >/dev/null; then
    fail "needs Debian packages, and there is no sudo here to install them; run as root: $command"
  fi
  may_be_root 2>/dev/null || fail "needs packages and may not install them here; run: sudo $command"
  say "installing Debian packages: $*"
  apt_get update || say "apt-get update failed; trying with the package lists at hand"
  apt_get install -y --no-install-recommends "$@" || fail "could not install them; run: sudo $command"
}

need_debian() { # lines "package probe"
  local names
  names=$(missing_packages "$@")
  # shellcheck disable=SC2086  # the names are meant to be split
  [ -z "$names" ] || install_debian $names
}

usable_python() { # true if $1 is new enough and can make a virtual environment
  "$1" -c "import sys, ensurepip, venv; sys.exit(sys.version_info < $min_python)" 2>/dev/null
}

find_python() { # prints a python that can make the environment
  local candidate
  for candidate in python3 /usr/bin/python3; do
    if usable_python "$candidate"; then echo "$candidate"; return 0; fi
  done
  return 1
}

make_venv() {
  local python
  if [ -x $venv/bin/python ] && usable_python $venv/bin/python && $venv/bin/python -m pip --version >/dev/null 2>&1; then
    return
  fi
  if ! find_python >/dev/null; then
    install_debian python3 python3-venv
  fi
  python=$(find_python) || fail "needs Python 3.11 or newer with the venv module (Debian 12: apt-get install python3-venv)"
  say "making the Python environment $venv"
  rm -rf $venv
  quietly "$python" -m venv $venv || fail "could not make $venv with $python"
}

fingerprint() { # of the environment's Python and of the files that pin its packages
  { $venv/bin/python -VV; cat "$@"; } | sha256sum | cut -d' ' -f1
}

pip_install() {
  quietly $venv/bin/python -m pip install --disable-pip-version-check --no-input "$@" \
    || fail "pip could not install the Python packages (pip's own words are above)"
}

# Each level's list includes the one before it, so a level is one list and the files it draws in.
host_lists=(requirements.txt)
demo_lists=(requirements-sim.txt "${host_lists[@]}" requirements-data.txt)
study_lists=(requirements-study.txt "${demo_lists[@]}")
test_lists=(requirements-dev.txt "${study_lists[@]}")

installed() { # level, its lists: true if exactly these were installed into this environment
  [ -f "$venv/.ferrite-$1" ] && [ "$(cat "$venv/.ferrite-$1")" = "$(fingerprint "${@:2}")" ]
}

need_python() { # level, its lists (the first is the one to install)
  if installed "$@"; then return; fi
  say "installing Python packages ($2)"
  pip_install -r "$2"
  case " $* " in *" requirements-data.txt "*) pip_install --no-deps -r requirements-data.txt ;; esac
  fingerprint "${@:2}" >"$venv/.ferrite-$1"
}

need_python_for() { # a level with lists of its own: nothing is done if it or a larger one is there
  local level larger=(test study demo host)
  for level in "${larger[@]}"; do
    local -n lists=${level}_lists
    if installed "$level" "${lists[@]}"; then return; fi
    if [ "$level" = "$1" ]; then need_python "$level" "${lists[@]}"; return; fi
  done
}

need_moonraker() { # folder: its own environment, its pins are not ours
  local own=$1 list=requirements-moonraker.txt python
  local pinned; pinned=$(sha256sum $list | cut -d' ' -f1)
  if [ -x $own/bin/moonraker ] && [ "$(cat $own/.ferrite 2>/dev/null)" = "$pinned" ]; then return; fi
  say "installing Moonraker into $own"
  python=$(find_python) || fail "needs Python 3.11 or newer with the venv module"
  rm -rf $own
  quietly "$python" -m venv $own || fail "could not make $own with $python"
  quietly $own/bin/python -m pip install --disable-pip-version-check --no-input -r $list \
    || fail "pip could not install Moonraker (pip's own words are above)"
  echo "$pinned" >$own/.ferrite
}

need_registers() { # the vendor's register table, for scripts/check/check_registers.py: one file out of a package of 35 MB
  local own=out/registers/STM32F334x.svd
  local package=cmsis-svd==0.4
  if [ -s $own ]; then return; fi
  say "fetching the register table of the STM32F334 ($package)"
  mkdir -p out/registers/fetched
  quietly $venv/bin/python -m pip download --disable-pip-version-check --no-input --no-deps --no-binary :all: \
    -d out/registers/fetched $package || fail "pip could not fetch $package (pip's own words are above)"
  tar -xzf out/registers/fetched/cmsis-svd-*.tar.gz -O --wildcards '*/data/STMicro/STM32F334x.svd' >$own.new
  mv $own.new $own
  rm -r out/registers/fetched
}

case $level in
  demo|study|moonraker|test|browser|flash|host|printer) ;;
  *) fail "say 'demo', 'study', 'moonraker', 'test', 'browser', 'flash', 'host' or 'printer', not '$level'" ;;
esac
# One set-up at a time: two makes started together would install over each other.
mkdir -p out
exec 9>out/.setup.lock
if command -v flock >/dev/null && ! flock -n 9; then
  say "waiting for another set-up of this checkout to end"
  flock 9
fi

declare -n packages=${level}_packages
need_debian "${packages[@]}"
make_venv
case $level in
  host|study) need_python_for "$level" ;;
  printer) need_python_for host ;;
  demo|moonraker) need_python_for demo ;;
  *) need_python_for test ;;
esac
case $level in
  moonraker|test|browser) need_moonraker out/moonraker-venv ;;
  printer) need_moonraker .moonraker ;;
esac
if [ "$level" = test ]; then need_registers; fi
