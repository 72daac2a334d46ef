# Read by the scripts that run under systemd in the guest: puts onto it what installation.py
# left in $out, for the interface vcan1 (the link unit must make it).
unit=soilbus@vcan1
note() { # what systemd says of the unit now
    systemctl status --no-pager --lines=20 $unit >"$out/$1.status" 2>&1 || true
    systemctl show $unit -p ActiveState,SubState,StatusText,MainPID,NRestarts,Result,ExecMainCode,ExecMainStatus >"$out/$1.show"
}

systemd-sysusers "$PWD/systemd/soilbus.sysusers"
mkdir -p /opt/soilbus/bin /etc/soilbus "/run/systemd/system/soilbus@.service.d"
cp "$out/soilbus" /opt/soilbus/bin/
cp "$out"/config/* /etc/soilbus/
mv /etc/soilbus/field.toml /etc/soilbus/vcan1.toml
cp "$out/dropin.conf" "/run/systemd/system/soilbus@.service.d/"
systemctl daemon-reload
