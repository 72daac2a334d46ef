#!/bin/sh
# Runs in a bare Debian in the guest, in a folder with `package` and `wheel`: does the commands of the page in each (its
# file "commands"), one after the other. What each said, and what there was afterwards, is left in folders 1, 2, ... in
# there. The package is upgraded, removed and purged before the wheel is installed.
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
listens() { # SECONDS: it starts while the last command asks
    for _ in $(seq $((5 * $1))); do
        if systemctl show -P StatusText $unit | grep -q '^listening'; then break; fi
        sleep 0.2
    done
}
page() { # the commands of this folder
    n=0
    while read -r line; do
        n=$((n + 1))
        mkdir "$n"
        eval "$line" </dev/null >"$n/said" 2>&1 || { echo "failed: $line"; cat "$n/said"; exit 1; }
        note "$n"
    done <commands
    listens 60
    systemctl status $unit >status
    note running
}

ip link add can0 type vcan # in place of an adapter: soilbus-link@ finds it up
ip link set can0 up
cd package
page
echo 'BITRATE=500000' >/etc/soilbus/can0.link
echo '# ours' >>/etc/soilbus/can0.toml
note before
apt-get install -y -o Dpkg::Options::=--force-confold ./later/soilbus_*.deb </dev/null
listens 60
note upgraded
dpkg-query -W -f '${Version}' soilbus >upgraded/version
apt-get remove -y soilbus </dev/null
note removed
cp /var/lib/soilbus/can0/state.json removed/
apt-get purge -y soilbus </dev/null
note purged
cd ../wheel
page
