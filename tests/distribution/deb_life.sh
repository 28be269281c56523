# The package's life in a booted Debian, as root: old.deb and new.deb are in /out. The first command that fails ends it.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
wait_for() { for _ in $(seq 1200); do if eval "$1" 2>/dev/null; then return; fi; sleep 0.1; done; echo "never: $1"; return 1; }
files() { find / -xdev \( -path /out -o -path /proc -o -path /sys -o -path /run -o -path /tmp -o -path /dev \) -prune -o -print | LC_ALL=C sort; }
# Version of the package and state of its service, once it publishes.
observe() {
  wait_for '[ "$(systemctl show --value -p ActiveState resonatord@left)" = active ]'
  wait_for '[[ "$(systemctl show --value -p StatusText resonatord@left)" == *" frames/s,"* ]]'
  timeout 60 mosquitto_sub -h 127.0.0.1 -C 1 -t 'resonator/left/forces' >"/out/$1.forces"
  systemctl show --value -p StatusText resonatord@left >"/out/$1.status"
  dpkg-query -W -f '${Version}\n' resonatord >"/out/$1.version"
  readlink "/proc/$(systemctl show --value -p MainPID resonatord@left)/exe" >"/out/$1.program"
  systemctl show --value -p MainPID resonatord@left >"/out/$1.pid"
  sha256sum /etc/resonatord/left.toml /etc/resonatord/left-plate.toml >"/out/$1.kept"
  resonatord replay "$recording" --to - 2>"/out/$1.replay" | wc -l >"/out/$1.replayed"
}

wait_for 'systemctl is-active -q multi-user.target'
files >/out/before
dpkg -i /out/old.deb
dpkg -V resonatord
test "$(stat -c '%U:%G %a' /etc/resonatord)" = 'root:resonatord 750'
pages=$(grep -oh '/usr/share/doc/[a-z/-]*\.md' /etc/resonatord/example.toml /lib/systemd/system/resonatord*)
for page in $pages; do test -e "$page"; done
test "$(wc -w <<<"$pages")" -ge 5
mkdir /run/work
bash /out/commands.sh /run/work

# Packages that it does not bring.
extras=/usr/local/lib/resonatord
(resonatord export "$(find /run/work -name run.mcap)" --format parquet --output /run/extra 2>&1 || true) | grep -- "--target $extras pyarrow"
mkdir -p $extras
echo 'version = "of extras"' | tee $extras/an_extra.py >$extras/numpy.py
/usr/lib/resonatord/bin/python -c 'import an_extra, numpy; assert an_extra.version == "of extras" != numpy.version'
rm -r $extras

systemd-run -q --unit=broker mosquitto
systemd-run -q --unit=emulator resonatord emulate --plate quartz16 --pty /run/board
wait_for '[ -e /run/board ]'
chgrp dialout /run/board && chmod 0660 /run/board
sed -e 's/^K = .*/&/' /usr/lib/resonatord/lib/python3.11/site-packages/resonator_daemon/base/plates/quartz16.toml >/etc/resonatord/left-plate.toml
printf '# a calibration of this plate\n' >>/etc/resonatord/left-plate.toml
printf '%s\n' 'name = "left"' 'plate = "left-plate.toml"' 'link = "serial:/run/board?baud=4000000"' \
  '[mqtt]' 'url = "mqtt://127.0.0.1:1883"' '[commands]' 'allow = ["start_recording", "stop_recording"]' \
  >/etc/resonatord/left.toml
chgrp resonatord /etc/resonatord/*.toml
resonatord check /etc/resonatord/left.toml
systemctl enable --now resonatord@left
wait_for '[[ "$(systemctl show --value -p StatusText resonatord@left)" == *" frames/s,"* ]]'
wait_for 'resonatord command left start_recording'
sleep 2
resonatord command left stop_recording
recording=$(find /var/lib/resonatord -name '*.mcap' | head -n 1)
test -n "$recording"
observe installed
sha256sum "$recording" >/out/recording.before

example=/etc/resonatord/example.toml
dpkg -i /out/new.deb
observe upgraded
test "$(cat /out/upgraded.version)" = 0.1.1
grep -x '# next' $example
dpkg -i /out/old.deb
observe rolled_back
cmp /out/installed.version /out/rolled_back.version
test "$(grep -l 'lost, next' /out/*.status)" = /out/upgraded.status

# An edited example stays, with the new one beside it.
echo '# edited' >>$example
sha256sum $example >/out/edited
dpkg --force-confdef --force-confold -i /out/new.deb
sha256sum --check /out/edited
grep -x '# next' $example.dpkg-dist
dpkg --force-confdef --force-confold -i /out/old.deb
sha256sum --check /out/edited
for phase in upgraded rolled_back; do
  grep -q '"name": *"left"' "/out/$phase.forces"
  cmp /out/installed.kept "/out/$phase.kept"
  cmp /out/installed.replayed "/out/$phase.replayed"
done
test "$(sort -u /out/*.pid | wc -l)" = 3
test "$(cat /out/installed.replayed)" -gt 100
sha256sum --check /out/recording.before

# The emulator is no service of the package.
systemctl stop emulator
dpkg -r resonatord
test -z "$(systemctl list-units --plain --no-legend --state=active,activating 'resonatord*@*.service')"
if pgrep -af 'bin/resonatord'; then false; fi
test "$(cd /etc/resonatord && echo *.toml)" = 'example.toml left-plate.toml left.toml'
sha256sum --check /out/edited
for path in /usr/lib/resonatord /usr/bin/resonatord /usr/share/doc/resonatord /lib/systemd/system/resonatord@.service; do test ! -e $path; done
dpkg -P resonatord
files >/out/after
# What docs/how-to/install.md states, then what the system itself writes while it runs.
stated='/etc/resonatord(/left(-plate)?\.toml)?|/var/lib/resonatord(/.*)?|/etc/(passwd|group|shadow|gshadow|\.pwd\.lock)-?'
system='/var/(log|cache/ldconfig|lib/(systemd|dpkg|mosquitto|private|apt))(/.*)?|/var/cache/private|/root(/.*)?'
LC_ALL=C comm -13 /out/before /out/after | grep -vxE "$stated|$system" >/out/left || true
test ! -s /out/left || { cat /out/left >&2; false; }
echo 'installed, upgraded, rolled back, removed, purged: passed' >/out/result
