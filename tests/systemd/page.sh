#!/bin/sh
# Runs in a bare Debian in the guest, in a folder with what the commands of the page (file "commands") want: does them
# one after the other. What each said, and what there was afterwards, is left in folders 1, 2, ...
set -eu
unit=soilbus@can0
note() { # NAME: what of soilbus there is now
    mkdir -p "$1"
    systemctl show $unit -p ActiveState,StatusText,MainPID,UnitFileState >"$1/show"
    getent passwd soilbus >"$1/user" || true
    find /etc /opt /usr/bin /usr/lib/systemd /usr/lib/sysctl.d /usr/lib/sysusers.d /var/lib \
        -path /var/lib/dpkg -prune -o -name '*soilbus*' -prune -print >"$1/files" || true # dpkg takes an empty /opt away
    if [ -e /etc/soilbus ]; then cp -r /etc/soilbus "$1/etc"; fi
    cat /proc/sys/net/core/rmem_max >"$1/rmem_max"
}
ip link add can0 type vcan # in place of an adapter: soilbus-link@ finds it up
ip link set can0 up
n=0
while read -r line; do
    n=$((n + 1))
    mkdir "$n"
    eval "$line" </dev/null >"$n/said" 2>&1 || { echo "failed: $line"; cat "$n/said"; exit 1; }
    note "$n"
done <commands
for _ in $(seq 60); do # it starts while the last command asks
    if systemctl show -P StatusText $unit | grep -q '^listening'; then break; fi
    sleep 1
done
systemctl status $unit >status
note running
