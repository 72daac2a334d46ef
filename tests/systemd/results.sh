#!/bin/sh
# Runs under systemd in the guest: results.sh OUT; OUT/soilbus-mqtt@.service is the unit of the page, OUT/frames.log
# frames of ours. A program that says what it gets stands for mosquitto_pub.
set -eu
out=$1
. tests/systemd/install.sh
cat >/usr/local/bin/mosquitto_pub <<'P'
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
systemctl start soilbus-link@vcan1 soilbus-mqtt@vcan1
said() { journalctl --no-pager -o cat -u soilbus-mqtt@vcan1; }
for _ in $(seq 300); do # it listens, and hears nothing yet
    if said | grep -q '^{'; then break; fi
    sleep 0.2
done
canplayer -I "$out/frames.log" vcan1=can0
systemctl stop soilbus-mqtt@vcan1
said >"$out/results"
systemctl show soilbus-mqtt@vcan1 -p NRestarts,Result >"$out/results.show"
