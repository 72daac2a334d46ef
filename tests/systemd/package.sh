#!/bin/sh
# Runs in a bare Debian in the guest, as page.sh does, with the commands for the package and a later version of it:
# afterwards upgrades, removes and purges it.
. ./page.sh

echo 'BITRATE=500000' >/etc/soilbus/can0.link
echo '# ours' >>/etc/soilbus/can0.toml
note before
apt-get install -y -o Dpkg::Options::=--force-confold ./later/soilbus_*.deb </dev/null
until systemctl show -P StatusText $unit | grep -q '^listening'; do sleep 0.2; done
note upgraded
dpkg-query -W -f '${Version}' soilbus >upgraded/version
apt-get remove -y soilbus </dev/null
note removed
cp /var/lib/soilbus/can0/state.json removed/
apt-get purge -y soilbus </dev/null
note purged
