# What is done in the container, by bash as root; what the tests look at is left in /out.
exec 2>/dev/null
wait_for() { for _ in $(seq 400); do if eval "$1"; then return; fi; sleep 0.05; done; echo "never: $1"; return 1; }
show() { systemctl show "$1" -p ActiveState,StatusText,NRestarts,MainPID,ExecMainStatus,Result; }
well() {
  python -c '
import json
daemon = json.load(open("/out/status"))["daemons"][0]
raise SystemExit(not daemon["broker"]["connected"] or daemon["link"]["state"] != "online")'
}
says() { [[ "$(systemctl show "$1" --value -p StatusText)" == *"$2"* ]]; }
emulator() {
  systemd-run -q --unit=emulator resonatord emulate --plate quartz16 --pty /run/board
  wait_for '[ -e /run/board ]'
  chgrp dialout /run/board && chmod 0660 /run/board
}
chmod 600 /etc/resonatord/broker.password
mosquitto_passwd -c -b /etc/mosquitto.password left secret
resonatord install
systemd-run -q --unit=broker mosquitto -c /etc/mosquitto.conf
emulator
systemctl start resonatord@left
wait_for 'resonatord status left --json > /out/status && well'
wait_for 'show resonatord@left > /out/started && grep -q "frames/s," /out/started'
cat /proc/$(systemctl show --value -p MainPID resonatord@left)/status > /out/process
stat -c '%U %a %n' /var/lib/resonatord /var/cache/resonatord /run/resonatord/left /etc/resonatord > /out/directories

systemctl reload resonatord@left
wait_for '[ "$(systemctl show --value -p ActiveState resonatord@left)" = active ]'
show resonatord@left > /out/reloaded

systemctl stop emulator
wait_for 'says resonatord@left "link waiting"'
sleep 3.5
show resonatord@left > /out/waiting

systemctl kill --signal=STOP --kill-who=main resonatord@left
wait_for '[ "$(systemctl show --value -p NRestarts resonatord@left)" = 1 ]'
emulator
wait_for 'says resonatord@left "frames/s,"'
show resonatord@left > /out/restarted

if systemctl start resonatord@bad; then false; fi
show resonatord@bad > /out/bad

systemctl start resonatord-decode@skin
show resonatord-decode@skin > /out/decoder
systemctl stop resonatord-decode@skin resonatord@left
show resonatord@left > /out/stopped
journalctl --sync
journalctl -o json -u 'resonatord@*' > /out/journal
