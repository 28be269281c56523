#!/bin/bash
# Build the Debian package of the present commit in dist/, for Debian 12: make_deb.sh amd64|arm64.
# It contains the wheel of dist/, and the packages of run.txt with the hashes that stand there, below /usr/lib/resonatord.
set -euo pipefail
umask 022
export LC_ALL=C.UTF-8 TZ=UTC
cd "$(dirname "$0")/.."
python=${PYTHON:-$PWD/.venv/bin/python}
architecture=$1
case $architecture in
  amd64) processor=x86_64 ;;
  arm64) processor=aarch64 ;;
  *) echo "make deb: ARCH=$architecture; use amd64 or arm64" >&2; exit 2 ;;
esac

wheel=$(ls dist/resonatord-*.whl)
version=$(basename "$wheel" | cut -d- -f2)
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
# Before it is tagged, a version sorts below itself.
git describe --exact-match --tags --match "v$version" HEAD >/dev/null 2>&1 ||
  version="$version~git$(date -d "@$SOURCE_DATE_EPOCH" +%Y%m%d%H%M%S).$(git rev-parse --short=8 HEAD)"

work=$PWD/build/deb-$architecture
source=$work/resonatord
stage=$work/stage
home=$stage/usr/lib/resonatord
site=$home/lib/python3.11/site-packages
rm -rf "$work"
mkdir -p "$source" "$home/bin" "$stage/usr/bin" "$stage/lib/systemd/system" "$stage/usr/share/doc" "$stage/etc/resonatord"
cp -R systemd/debian "$source/debian"
printf 'resonatord (%s) bookworm; urgency=medium\n\n  * Commit %s.\n\n -- the resonatord authors <resonatord@localhost>  %s\n' \
  "$version" "$(git rev-parse HEAD)" "$(date -R -d "@$SOURCE_DATE_EPOCH")" >"$source/debian/changelog"
{
  printf 'Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\n\n'
  printf 'Files: *\nCopyright: %s\nLicense: BSD-3-Clause\n' "$(sed -n 's/^Copyright (c) //p' LICENSE)"
  sed -e 1,2d -e '/^Copyright/d' -e 's/^$/./' -e 's/^/ /' LICENSE | sed 1d
  printf '\nFiles: usr/lib/resonatord/lib/*\nCopyright: the authors of each package\nLicense: various\n'
  printf ' The licence of each Python package is in its .dist-info directory.\n'
} >"$source/debian/copyright"

# The packages.
platforms=(--platform "manylinux2014_$processor")
for minor in $(seq 36 -1 17); do platforms+=(--platform "manylinux_2_${minor}_$processor"); done
pip=("$python" -m pip install -qq --no-input --disable-pip-version-check --no-compile --no-deps)
"${pip[@]}" --target "$site" --only-binary :all: --python-version 3.11 --implementation cp "${platforms[@]}" \
  --require-hashes -r .ci/requirements/run.txt
"${pip[@]}" --target "$work/wheel" "$wheel"

# Units, rules, completion and manual, as `resonatord install` writes them, where packages have them and without its seal.
PYTHONPATH=$work/wheel "$python" -P - install --prefix "$work/image" 2>/dev/null >&2 <<'INSTALL'
from resonator_daemon.base.host import text
text.page = "/usr/share/doc/resonatord/{}".format
from resonator_daemon.commands import main
raise SystemExit(main())
INSTALL
program=$(dirname "$python")/resonatord
find "$work/image" -type f -exec sed -i -e '/^\(#\|\.\\"\) resonatord install [0-9a-f]*$/d' \
  -e "s#$program#/usr/bin/resonatord#g" {} +
mv "$work"/image/etc/systemd/system/*.service "$stage/lib/systemd/system/"
mv "$work/image/etc/resonatord/example.toml" "$stage/etc/resonatord/"
mv "$work/image/usr/local/share"/* "$stage/usr/share/"
mkdir -p "$stage/usr/share/zsh"
mv "$stage/usr/share/zsh/site-functions" "$stage/usr/share/zsh/vendor-completions"
mv "$work/image/etc/udev/rules.d/70-resonatord.rules" "$source/debian/resonatord.udev"
mv "$work/image/etc/sysusers.d/resonatord.conf" "$source/debian/resonatord.sysusers"
mv "$work/image/etc/tmpfiles.d/resonatord.conf" "$source/debian/resonatord.tmpfiles"

# The environment: no pip, no paths of the computer that builds.
mv "$work/wheel/share/doc/resonatord" "$stage/usr/share/doc/resonatord"
rm -rf "$site"/{bin,share} "$work"/wheel/{bin,share} "$work"/wheel/*.dist-info/direct_url.json
cp -R "$work"/wheel/. "$site"
mkdir -p "$home/share/doc"
ln -s ../../../../share/doc/resonatord "$home/share/doc/resonatord"
sed -i -e '/^\.\.\//d' -e '/direct_url.json,/d' "$site"/*.dist-info/RECORD
printf 'home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11\n' >"$home/pyvenv.cfg"
# Optional packages, of `pip install --target`; those of the package come first.
echo /usr/local/lib/resonatord >"$site/extras.pth"
ln -s ../../../bin/python3.11 "$home/bin/python"
printf '%s\n' '#!/usr/lib/resonatord/bin/python' 'import sys' '' 'from resonator_daemon.commands import main' '' \
  'sys.exit(main())' >"$home/bin/resonatord"
chmod 0755 "$home/bin/resonatord"
ln -s ../lib/resonatord/bin/resonatord "$stage/usr/bin/resonatord"

(cd "$source" && STAGE=$stage DEB_BUILD_OPTIONS=nocheck \
  dpkg-buildpackage --build=binary --host-arch="$architecture" --no-sign -d) >"$work/build.log" 2>&1 ||
  { tail -n 30 "$work/build.log"; echo "make deb: dpkg-buildpackage failed; see $work/build.log"; exit 1; } >&2
mv "$work/resonatord_${version}_$architecture.deb" dist/
echo "dist/resonatord_${version}_$architecture.deb"
