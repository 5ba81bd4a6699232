#!/usr/bin/env bash
# Installs the host, Moonraker and a web front end as services of a Debian or Raspberry Pi OS.
#
#   scripts/install.sh [options]
#
#   --front-end NAME   mainsail (default), fluidd, dashboard (ours, plain), none, or a folder with an unpacked release
#   --port N           port of the front end (default 80)
#   --no-moonraker     the host only
#   --moonraker-port N (default 7125)
#   --data DIR         folder with config, gcodes, logs, comms (default ~/printer_data)
#   --name NAME        name of the host's service (default klipper, which installers of plugins look for)
#   --no-packages      leave Debian and Python packages alone, and download no front end
#   --no-start         write files only; the units to DATA/systemd, with the commands that install them
#   --uninstall        stop and remove the services; data and checkout stay
#
# What it makes: .venv and .moonraker in the checkout, the data folder with a first printer.cfg and moonraker.conf, links
# ~/klipper and ~/klippy-env for installers of plugins, and units in /etc/systemd/system. It overwrites no config. A
# second printer needs another --name, --data and other ports. Run it as the user who is to own the printer.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD

data=$HOME/printer_data
name=klipper
front_end=mainsail
port=80
moonraker=yes
moonraker_port=7125
packages=yes
start=yes
uninstall=no

say()  { printf 'install: %s\n' "$*"; }
fail() { printf 'install: %s\n' "$*" >&2; exit 1; }

while [ $# -gt 0 ]; do
  case $1 in
    --data) data=${2:?--data needs a folder}; shift ;;
    --name) name=${2:?--name needs a name}; shift ;;
    --front-end) front_end=${2:?--front-end needs mainsail, fluidd, none or a folder}; shift ;;
    --port) port=${2:?--port needs a number}; shift ;;
    --moonraker-port) moonraker_port=${2:?--moonraker-port needs a number}; shift ;;
    --no-moonraker) moonraker=no; front_end=none ;;
    --no-packages) packages=no ;;
    --no-start) start=no ;;
    --uninstall) uninstall=yes ;;
    -h|--help) sed -n '2,20s/^# \{0,1\}//p' "$0"; exit 0 ;;
    *) fail "unknown option '$1' (see --help)" ;;
  esac
  shift
done
[[ $name =~ ^[A-Za-z0-9_-]+$ ]] || fail "the name of the service may have letters, digits, '-' and '_'"
[[ $port =~ ^[0-9]+$ && $moonraker_port =~ ^[0-9]+$ ]] || fail "--port and --moonraker-port need numbers"
case $data in /*) ;; *) data=$PWD/$data ;; esac
case $data/ in "$root"/*) fail "the data folder must be outside of $root: Moonraker refuses uploads below it" ;; esac
[ "$(id -u)" -ne 0 ] || [ "$start" = no ] || fail "run it as the user who is to own the printer, not as root"
user=$(id -un)

# The other services have the host's name in theirs if that is another one than usual.
suffix=
[ "$name" = klipper ] || suffix=-$name
names=("$name")
[ "$moonraker" = no ] || names+=("moonraker$suffix")
[ "$front_end" = none ] || names+=("front-end$suffix")

case $front_end in
  mainsail) repo=mainsail-crew/mainsail; pages=$HOME/mainsail ;;
  fluidd)   repo=fluidd-core/fluidd; pages=$HOME/fluidd ;;
  dashboard) repo=; pages=$root/klippy/webhooks/dashboard ;;
  none)     repo=; pages= ;;
  *) repo=; pages=$(cd "$front_end" 2>/dev/null && pwd) || fail "there is no folder $front_end; --front-end takes mainsail, fluidd, dashboard, none or a folder"
     [ -e "$pages/index.html" ] || fail "$pages has no index.html: it is not the unpacked release of a web front end" ;;
esac

# Whatever can be missing is looked at before anything is changed.
by_hand="--no-start writes the files and says what root is to do with them"
units=/etc/systemd/system
if [ "$start" = yes ]; then
  command -v systemctl >/dev/null || fail "there is no systemd here (no systemctl), so no service can be set up; $by_hand"
  [ "$(systemctl is-system-running 2>/dev/null || true)" != offline ] || fail "systemd does not run here (a container or a chroot?), so no service can be started; $by_hand"
  command -v sudo >/dev/null || fail "there is no sudo here, and services belong to root; $by_hand"
  sudo=(sudo -n)
  [ ! -t 0 ] || sudo=(sudo)
  "${sudo[@]}" true 2>/dev/null || fail "sudo gives $user no rights here, and services belong to root; $by_hand"
  for unit in "${names[@]}"; do
    if [ -e "$units/$unit.service" ] && ! grep -qF "$root" "$units/$unit.service"; then
      fail "$units/$unit.service is another program's; stop and remove that one, or choose another --name"
    fi
  done
fi

remove_links() {
  local link
  for link in "$HOME/klipper" "$HOME/klippy-env"; do
    case $(readlink "$link" 2>/dev/null || true) in "$root"|"$root/.venv") rm "$link" ;; esac
  done
}

if [ "$uninstall" = yes ]; then
  if [ "$start" = yes ]; then
    for unit in "${names[@]}"; do
      "${sudo[@]}" systemctl disable --now "$unit" 2>/dev/null || true
      "${sudo[@]}" rm -f "$units/$unit.service"
    done
    "${sudo[@]}" systemctl daemon-reload
  fi
  rm -rf "$data/systemd"
  [ "$name" != klipper ] || remove_links
  say "removed the services ${names[*]}; $data and $root are as they were"
  exit 0
fi

if [ "$packages" = yes ]; then
  scripts/setup.sh "$([ "$moonraker" = yes ] && echo printer || echo host)" || exit  # it has said why
  .venv/bin/python -c "import sys; sys.path.insert(0, 'klippy'); import chelper; chelper.get_ffi()" \
    || fail "the host's C helper could not be built (see above); nothing was set up"
fi

if [ -n "$repo" ] && [ ! -e "$pages/index.html" ]; then
  url=https://github.com/$repo/releases/latest/download/$front_end.zip
  if [ "$packages" = yes ] && .venv/bin/python scripts/build/fetch_pages.py "$url" "$pages"; then
    say "unpacked $front_end into $pages"
  else
    say "going on with a plain dashboard. For $front_end unpack $url into $pages, then run this again"
    say "http://my.mainsail.xyz and http://app.fluidd.xyz can use this printer, too, if the browser allows it"
    repo=
    pages=$root/klippy/webhooks/dashboard
  fi
fi

mkdir -p "$data"/{config,gcodes,logs,comms}
if [ ! -e "$data/config/printer.cfg" ]; then
  sed "s|^path: .*gcodes.*|path: $data/gcodes|" config/example-induction-f334.cfg >"$data/config/printer.cfg"
  [ -e "$data/config/macros-induction.cfg" ] || cp config/macros-induction.cfg "$data/config/"
  say "wrote $data/config/printer.cfg from config/example-induction-f334.cfg: edit it for your machine"
fi

web_entry() { # an entry of Moonraker's update manager for a front end from its release
  [ -n "$repo" ] || return 0
  printf '\n[update_manager %s]\ntype: web\nchannel: stable\nrepo: %s\npath: %s\n' "$front_end" "$repo" "$pages"
}

host_entry() { # one for the host, if the checkout knows where it came from
  local origin
  origin=$(git remote get-url origin 2>/dev/null) || return 0
  printf '\n[update_manager ferrite]\ntype: git_repo\npath: %s\norigin: %s\nprimary_branch: main\n' "$root" "$origin"
  printf 'managed_services: %s\n' "$name"
}

if [ "$moonraker" = yes ] && [ ! -e "$data/config/moonraker.conf" ]; then
  { cat <<CONF; web_entry; host_entry; } >"$data/config/moonraker.conf"
# Moonraker: computers of the private network may use the printer, and the hosted front ends from there.
[server]
host: 0.0.0.0
port: $moonraker_port
klippy_uds_address: $data/comms/klippy.sock

[authorization]
trusted_clients:
    10.0.0.0/8
    127.0.0.0/8
    169.254.0.0/16
    172.16.0.0/12
    192.168.0.0/16
    FE80::/10
    ::1/128
cors_domains:
    *.lan
    *.local
    *://localhost
    *://localhost:*
    *://my.mainsail.xyz
    *://app.fluidd.xyz

[machine]
validate_service: False

[octoprint_compat]

[history]

[update_manager]
enable_auto_refresh: False
CONF
  say "wrote $data/config/moonraker.conf"
fi

# --- services -------------------------------------------------------------------------------------
made=$data/systemd
rm -rf "$made"
mkdir -p "$made"

unit() { # name, description, what it comes after, command, more lines of [Service]
  cat >"$made/$1.service" <<UNIT
[Unit]
Description=$2
Documentation=file://$root/docs/guides/Installation.md
After=$3

[Service]
User=$user
ExecStart=$4
Restart=always
RestartSec=5
${5:-}
[Install]
WantedBy=multi-user.target
UNIT
}

# The limits let the host ask for real-time priority and locked memory; klippy.log says whether it got them.
unit "$name" "Ferrite, 3D printer host" network.target \
  "\"$root/.venv/bin/python\" \"$root/klippy/klippy.py\" \"$data/config/printer.cfg\" -l \"$data/logs/klippy.log\" -a \"$data/comms/klippy.sock\" -I \"$data/comms/klippy.serial\"" \
  $'LimitRTPRIO=1\nLimitMEMLOCK=infinity\n'
online=$'network-online.target\nWants=network-online.target'
[ "$moonraker" = no ] || unit "moonraker$suffix" "Moonraker, API server of a 3D printer" "$name.service $online" \
  "\"$root/.moonraker/bin/moonraker\" -d \"$data\""
[ "$front_end" = none ] || unit "front-end$suffix" "Web front end of a 3D printer" "$online" \
  "/usr/bin/python3 \"$root/klippy/webhooks/front_end.py\" \"$pages\" --port $port --moonraker $moonraker_port" \
  $'AmbientCapabilities=CAP_NET_BIND_SERVICE\n'

if [ "$name" = klipper ]; then
  for link in "klipper $root" "klippy-env $root/.venv"; do
    if [ -e "$HOME/${link%% *}" ] && [ "$(readlink "$HOME/${link%% *}")" != "${link#* }" ]; then
      say "$HOME/${link%% *} is there already and stays; installers of plugins will look into it"
    else
      ln -sfn "${link#* }" "$HOME/${link%% *}"
    fi
  done
fi

if [ "$start" = no ]; then
  say "wrote the units to $made; as root: cp $made/*.service $units/ && systemctl daemon-reload && systemctl enable --now ${names[*]}"
  exit 0
fi
old=${XDG_CONFIG_HOME:-$HOME/.config}/systemd/user/ferrite.service
if [ -e "$old" ] && grep -qF "$root" "$old"; then  # of an earlier version, which made a service of the user
  systemctl --user disable --now ferrite 2>/dev/null || true
  rm -f "$old"
  say "removed $old, the service of an earlier version"
fi
"${sudo[@]}" cp "$made"/*.service "$units/" || fail "the units in $made could not be copied to $units"
case " $(id -nG) " in
  *" dialout "*) ;;
  *) "${sudo[@]}" usermod -a -G dialout "$user" || say "run: sudo usermod -a -G dialout $user (it may use serial ports then)" ;;
esac
"${sudo[@]}" systemctl daemon-reload
"${sudo[@]}" systemctl enable --now "${names[@]}" || fail "a service did not start; see: systemctl status ${names[*]}"
say "started ${names[*]}; see: systemctl status $name, and $data/logs/klippy.log"
[ "$front_end" = none ] || say "front end: http://$(uname -n):$port/"
[ "$moonraker" = no ] || say "Moonraker: http://$(uname -n):$moonraker_port/"
