#!/bin/sh
# Runs under systemd in the guest: drive.sh OUT, OUT/soilbus is the command, OUT/config its
# configuration, OUT/dropin.conf what a checkout needs, OUT/played.log the recording,
# OUT/soilbus-mqtt@.service the page's unit that sends results on.
# Everything the test judges is left in OUT.
set -eu
out=$1
. tests/systemd/install.sh
cat >/usr/local/bin/mosquitto_pub <<'P' # a program that says what it gets stands for mosquitto's
#!/bin/sh
echo "user: $(id -un); options: $(cat "$XDG_CONFIG_HOME/mosquitto_pub"); arguments: $*"
exec cat
P
chmod 755 /usr/local/bin/mosquitto_pub
(umask 077 && printf %s '-h 192.0.2.10' >/etc/soilbus/mosquitto_pub)
cp "$out/soilbus-mqtt@.service" /run/systemd/system/
mkdir -p "/run/systemd/system/soilbus-mqtt@.service.d"
cp "$out/dropin.conf" "/run/systemd/system/soilbus-mqtt@.service.d/"
systemctl daemon-reload
said() { journalctl --no-pager -o cat -u soilbus-mqtt@vcan1; }

systemctl start $unit || { note failed; journalctl --no-pager -n 50; exit 1; }
note started
process=/proc/$(systemctl show -P MainPID $unit)
cat "$process/status" >"$out/process"
cat "$process/mountinfo" >"$out/mounts"
ip -details link show vcan1 >"$out/link"
systemctl start soilbus-mqtt@vcan1
until said | grep -q '^{'; do sleep 0.2; done # it listens
candump -L -r 4194304 vcan1 >"$out/bus.log" &
candump=$!
canplayer -l i -I "$out/played.log" vcan1=can0 & # again and again: the service may take long to come back
candump -n "$(cat "$out/frames-until-window")" vcan1,510:7FF >/dev/null # until a window is full
note playing
until said | grep -q '"window": 2,'; do sleep 0.2; done
systemctl stop soilbus-mqtt@vcan1
said >"$out/results"
systemctl show soilbus-mqtt@vcan1 -p NRestarts,Result >"$out/results.show"

systemctl kill -s KILL $unit
until [ "$(systemctl show -P NRestarts $unit)" = 1 ] && systemctl is-active -q $unit; do sleep 0.1; done
note restarted
until systemctl show -P StatusText $unit | grep -Eq '^(estimating|valid|degraded)'; do sleep 0.1; done # it hears the bus
kill $! 2>/dev/null || true
systemctl stop $unit
note stopped
cp /var/lib/soilbus/vcan1/state.json "$out/"
kill $candump
journalctl --no-pager -u $unit -u soilbus-link@vcan1 >"$out/journal"
