#!/bin/sh
# Runs under systemd in the guest: faults.sh OUT, with OUT as installation.py prepares it. Drives the service beside a
# unit that sends its results on, then breaks it in every way that its watchdog, its state and its sandbox are there
# for. Everything the tests judge is left in OUT.
set -eu
out=$1
unit=soilbus@vcan1 # the link unit must make the interface
state=/var/lib/soilbus/vcan1/state.json
note() { # what systemd says of the unit now
    systemctl status --no-pager --lines=20 $unit >"$out/$1.status" 2>&1 || true
    systemctl show $unit -p ActiveState,SubState,StatusText,MainPID,NRestarts,Result,ExecMainCode,ExecMainStatus >"$out/$1.show"
}
dropin() { # UNIT FILE...
    mkdir -p "/run/systemd/system/$1.service.d"
    cp "$2" "/run/systemd/system/$1.service.d/"
}

systemd-sysusers "$PWD/systemd/soilbus.sysusers"
mkdir -p /opt/soilbus/bin /opt/soilbus/hooks /etc/soilbus
cp "$out/soilbus" /opt/soilbus/bin/
cp tests/systemd/hooks/sitecustomize.py /opt/soilbus/hooks/
cp "$out"/config/* /etc/soilbus/
mv /etc/soilbus/field.toml /etc/soilbus/vcan1.toml
printf '\n[estimator]\nwindow = 4.0\n' >>/etc/soilbus/vcan1.toml
cat >/usr/local/bin/mosquitto_pub <<'P' # a program that says what it gets stands for mosquitto's
#!/bin/sh
echo "user: $(id -un); options: $(cat "$XDG_CONFIG_HOME/mosquitto_pub"); arguments: $*"
exec cat
P
chmod 755 /usr/local/bin/mosquitto_pub
(umask 077 && printf %s '-h 192.0.2.10' >/etc/soilbus/mosquitto_pub)
cp "$out/soilbus-mqtt@.service" /run/systemd/system/
dropin soilbus@ "$out/checkout.conf"
dropin soilbus@ "$out/faults.conf"
dropin soilbus-mqtt@ "$out/checkout.conf"
systemctl daemon-reload

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
said() { journalctl --no-pager -o cat -u soilbus-mqtt@vcan1; }
sent_on() { said | grep -q "$1"; }
journal() { journalctl --no-pager -o cat -u $unit --after-cursor="$cursor" >"$out/$1.journal"; }
cursor() { cursor=$(journalctl -q -n 0 --show-cursor | sed -n 's/^-- cursor: //p'); }
is_on() { [ "$(restarts)" = "$1" ] && systemctl is-active -q $unit; }
: >"$out/restarts"

# A drive on the bus, whose results another unit sends on; a kill; a stop.
systemctl start $unit || { note failed; journalctl --no-pager -n 50; exit 1; }
note started
process=/proc/$(systemctl show -P MainPID $unit)
cat "$process/status" >"$out/process"
cat "$process/mountinfo" >"$out/mounts"
ip -details link show vcan1 >"$out/link"
systemctl start soilbus-mqtt@vcan1
within 30 sent_on '^{' # it listens
candump -L -r 4194304 vcan1 >"$out/bus.log" &
candump=$!
canplayer -l i -I "$out/played.log" vcan1=can0 & # again and again
player=$!
candump -n "$(cat "$out/frames-until-window")" vcan1,510:7FF >/dev/null # until a window is full
note playing
within 60 sent_on '"window": 2,'
systemctl stop soilbus-mqtt@vcan1
said >"$out/results"
systemctl show soilbus-mqtt@vcan1 -p NRestarts,Result >"$out/results.show"
systemctl kill -s KILL $unit
within 30 is_on 1
note restarted
within 30 says '^\(estimating\|valid\|degraded\)' # it hears the bus
kill $player $candump
systemctl stop $unit
note stopped
cp $state "$out/killed.json"
journalctl --no-pager -u $unit -u soilbus-link@vcan1 >"$out/drive.journal"

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
