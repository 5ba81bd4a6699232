#!/usr/bin/env bash
# Installs the host as a user service (systemd) on a Raspberry-Pi-like Debian, next to Moonraker if that is there.
#
#   scripts/install.sh [--data DIR] [--name NAME] [--no-packages] [--no-start] [--uninstall]
#
#   --data DIR      folder with config, gcodes, logs, comms (default ~/printer_data, which Moonraker uses, too)
#   --name NAME     name of the service (default ferrite); a second printer needs another name and folder
#   --no-packages   leave Debian and Python packages alone
#   --no-start      write the files only
#   --uninstall     stop and remove the service; the data folder stays
#
# What it makes: .venv in the checkout, the data folder with a first printer.cfg, and
# ~/.config/systemd/user/NAME.service. It never overwrites a printer.cfg. Run as the user who is to own the printer.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD

data=$HOME/printer_data
name=ferrite
packages=yes
start=yes
uninstall=no

say()  { printf 'install: %s\n' "$*"; }
fail() { printf 'install: %s\n' "$*" >&2; exit 1; }

while [ $# -gt 0 ]; do
  case $1 in
    --data) data=${2:?--data needs a folder}; shift ;;
    --name) name=${2:?--name needs a name}; shift ;;
    --no-packages) packages=no ;;
    --no-start) start=no ;;
    --uninstall) uninstall=yes ;;
    -h|--help) sed -n '2,14s/^# \{0,1\}//p' "$0"; exit 0 ;;
    *) fail "unknown option '$1' (see --help)" ;;
  esac
  shift
done
[[ $name =~ ^[A-Za-z0-9_-]+$ ]] || fail "the name of the service may have letters, digits, '-' and '_'"
case $data in /*) ;; *) data=$PWD/$data ;; esac
case $data/ in "$root"/*) fail "the data folder must be outside of $root: Moonraker refuses uploads below it" ;; esac
[ "$(id -u)" -ne 0 ] || [ "$start" = no ] || fail "run it as the user who is to own the printer, not as root"

units=${XDG_CONFIG_HOME:-$HOME/.config}/systemd/user
unit=$units/$name.service

# Whatever can be missing is looked at before anything is changed.
if [ "$start" = yes ]; then
  command -v systemctl >/dev/null \
    || fail "there is no systemd here (no systemctl), so no service can be set up; --no-start works on the files only"
  systemctl --user show-environment >/dev/null 2>&1 \
    || fail "systemd serves no user $(id -un) here (systemctl --user cannot connect): log in as that user, not by su or sudo; --no-start works on the files only"
fi

if [ "$uninstall" = yes ]; then
  [ "$start" = no ] || systemctl --user disable --now "$name" 2>/dev/null || true
  rm -f "$unit"
  [ "$start" = no ] || systemctl --user daemon-reload
  say "removed $unit; $data and $root are as they were"
  exit 0
fi

if [ "$packages" = yes ]; then
  scripts/setup.sh host || exit  # it has said why
  .venv/bin/python -c "import sys; sys.path.insert(0, 'klippy'); import chelper; chelper.get_ffi()" \
    || fail "the host's C helper could not be built (see above); nothing was set up"
fi

mkdir -p "$data"/{config,gcodes,logs,comms} "$units"
if [ ! -e "$data/config/printer.cfg" ]; then
  sed "s|^path: .*gcodes.*|path: $data/gcodes|" config/example-induction-f334.cfg >"$data/config/printer.cfg"
  [ -e "$data/config/macros-induction.cfg" ] || cp config/macros-induction.cfg "$data/config/"
  say "wrote $data/config/printer.cfg from config/example-induction-f334.cfg: edit it for your machine"
fi

cat >"$unit" <<UNIT
[Unit]
Description=Ferrite 3D printer host ($name)
Documentation=file://$root/docs/guides/Getting_Started.md
After=network.target

[Service]
ExecStart="$root/.venv/bin/python" "$root/klippy/klippy.py" "$data/config/printer.cfg" -l "$data/logs/klippy.log" -a "$data/comms/klippy.sock" -I "$data/comms/klippy.serial"
Restart=always
RestartSec=5

[Install]
WantedBy=default.target
UNIT
say "wrote $unit"

groups=$(id -nG)
case " $groups " in
  *" dialout "*) ;;
  *) say "you are not in the group dialout, which may use serial ports: sudo usermod -a -G dialout $(id -un)" ;;
esac

if [ "$start" = yes ]; then
  systemctl --user daemon-reload
  systemctl --user enable --now "$name"
  # without this the service would end when you log out
  loginctl enable-linger "$(id -un)" 2>/dev/null || say "run: sudo loginctl enable-linger $(id -un)"
  say "started; see: systemctl --user status $name, and $data/logs/klippy.log"
fi
say "Moonraker: set klippy_uds_address: $data/comms/klippy.sock in its [server] section"
