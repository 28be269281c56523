#!/bin/bash
# The package $1 is built again elsewhere and later, with equal bytes. Then a Debian (build/debian) boots with systemd-nspawn and runs
# deb_life.sh, with the package and a next version: other code, another example of a configuration.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
site=usr/lib/resonatord/lib/python3.11/site-packages
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
root=$(cd "$here/../.." && pwd)
package=$(realpath "$1")
again=$place/elsewhere/checkout
(
  umask 077
  git clone --quiet --no-hardlinks "$root" "$again"
  export PYTHON=$root/.venv/bin/python PYTHONHASHSEED=7 TZ=Asia/Kathmandu LC_ALL=C
  cd "$again"
  faketime -f +2d "$PYTHON" .ci/make_dist.py
  faketime -f +2d .ci/make_deb.sh "$(dpkg-deb -f "$package" Architecture)"
) >/dev/null
cmp "$package" "$again/dist/${package##*/}"
echo 'built twice, equal bytes: passed'

mkdir "$place/out"
cp "$package" "$place/out/old.deb"
cp "$here/commands.sh" "$here/deb_life.sh" "$place/out"
dpkg-deb -R "$package" "$place/tree"
sed -i 's/^Version: .*/Version: 0.1.1/' "$place/tree/DEBIAN/control"
sed -i 's#frames/s, {lost} lost#frames/s, {lost} lost, next#' "$place/tree/$site/resonator_daemon/daemon/service/daemon.py"
printf '# next\n' >>"$place/tree/etc/resonatord/example.toml"
dpkg-deb --root-owner-group -Zgzip -z1 -b "$place/tree" "$place/out/new.deb" >/dev/null
cp -a "$root/build/debian" "$place/root"
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
