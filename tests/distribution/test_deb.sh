#!/bin/bash
# Boot a Debian (build/debian) with systemd-nspawn and run deb_life.sh in it, with the package $1 and the same files as a next version.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
mkdir "$place/out"
cp "$1" "$place/out/old.deb"
cp "$here/commands.sh" "$here/deb_life.sh" "$place/out"
dpkg-deb -R "$1" "$place/tree"
sed -i 's/^Version: .*/Version: 0.1.1/' "$place/tree/DEBIAN/control"
dpkg-deb --root-owner-group -Zgzip -z1 -b "$place/tree" "$place/out/new.deb" >/dev/null
cp -a "$here/../../build/debian" "$place/root"
cat >"$place/root/etc/systemd/system/life.service" <<'UNIT'
[Unit]
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
TimeoutStartSec=1500
ExecStart=/bin/bash -euxo pipefail /out/deb_life.sh
StandardOutput=file:/out/stdout
StandardError=file:/out/stderr
ExecStartPost=/bin/touch /out/done
UNIT
timeout 1700 systemd-nspawn --quiet --directory="$place/root" --bind="$place/out:/out" --machine=resonatord-deb --boot --register=no \
  --keep-unit --private-network --console=pipe -- systemd.wants=life.service </dev/null >"$place/console" 2>&1 || true
if [ ! -e "$place/out/done" ]; then
  tail -n 20 "$place/console" "$place/out/stdout" "$place/out/stderr" >&2
  echo "make test-deb: the last command above failed" >&2
  exit 1
fi
cat "$place/out/result"
