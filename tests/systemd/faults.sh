#!/bin/sh
# Runs under systemd in the guest: faults.sh OUT, with OUT as drive.sh wants it. Breaks the
# service in every way that its watchdog, its state and its sandbox are there for.
set -eu
out=$1
. tests/systemd/install.sh
mkdir -p /opt/soilbus/hooks
cp tests/systemd/hooks/sitecustomize.py /opt/soilbus/hooks/
printf '\n[estimator]\nwindow = 4.0\n' >>/etc/soilbus/vcan1.toml
state=/var/lib/soilbus/vcan1/state.json

restarts() { systemctl show -P NRestarts $unit; }
text() { systemctl show -P StatusText $unit; }
within() { # SECONDS COMMAND...: until it succeeds; a note in OUT where it never does
    limit=$(($(date +%s) + $1))
    shift
    until "$@"; do
        if [ "$(date +%s)" -gt $limit ]; then echo "never: $*" >>"$out/never"; return 0; fi
        sleep 0.2
    done
}
fault() { echo "$1 $(systemctl show -P MainPID $unit)" >/run/fault; }
says() { text | grep -q "$1"; }
restarted_since() { [ "$(restarts)" -gt "$1" ] && systemctl is-active -q $unit; }
journal() { journalctl --no-pager -o cat -u $unit --after-cursor="$cursor" >"$out/$1.journal"; }
cursor() { cursor=$(journalctl -q -n 0 --show-cursor | sed -n 's/^-- cursor: //p'); }
: >"$out/restarts"

# Nothing to do: silence, then no bus at all, then another bus of the same name.
cursor
systemctl start $unit || { note failed; journalctl --no-pager -n 50; exit 1; }
sleep 8
says no_frames && text >"$out/silent"
ip link set vcan1 down
sleep 8
text >"$out/down"
ip link del vcan1
sleep 1
ip link add vcan1 type vcan
ip link set vcan1 up
within 5 says no_frames
echo "silence $(restarts)" >>"$out/restarts"

# Something to do: each of these must end in a restart by the watchdog.
canplayer -l i -I "$out/played.log" vcan1=can0 &
player=$!
for fault in loop estimator; do
    within 40 says kPa
    before=$(restarts)
    fault $fault
    if [ $fault = estimator ]; then
        within 20 says fault
        within 8 says "deadline misses" # a window later, about when the fault is noticed
        text >"$out/estimator"
    fi
    within 60 restarted_since "$before"
    rm /run/fault
    echo "$fault $(($(restarts) - before))" >>"$out/restarts"
done
journal watchdog

within 40 says kPa
systemctl stop $unit
cp $state "$out/kept.json"

# State that cannot be used, then a full disk.
cursor
echo '{"format": "something else"}' >$state
systemctl start $unit
within 10 says '[a-z]'
systemctl stop $unit
journal foreign
cp $state "$out/fresh.json"
mount -t tmpfs -o size=4k,mode=755 tmpfs /var/lib/soilbus/vcan1
dd if=/dev/zero of=/var/lib/soilbus/vcan1/full bs=4k count=1 2>/dev/null
cursor
systemctl start $unit
within 40 says kPa
text >"$out/full"
systemctl stop $unit
journal full
ls -A /var/lib/soilbus/vcan1 >"$out/full.files"
umount /var/lib/soilbus/vcan1

# A configuration that cannot work ends it for good, in one line.
cursor
before=$(restarts)
echo 'nonsense = 1' >>/etc/soilbus/vcan1.toml
systemctl start $unit 2>/dev/null || true
sleep 3
journal nonsense
systemctl show $unit -p NRestarts,ActiveState,ExecMainStatus >"$out/nonsense.show"
kill $player
journalctl --no-pager >"$out/journal"
