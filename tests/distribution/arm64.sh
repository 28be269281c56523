#!/usr/bin/env bash
# The product on arm64, in a Debian root under user-mode emulation: set-up, a demo, and every tenth test. Needs root.
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD/build/arm64

# The wheels of every pinned package, for the Pythons and the two processors that are supported.
for python in 3.11 3.12 3.13 3.14; do
  for machine in x86_64 aarch64; do
    for file in run test; do
      .venv/bin/uv pip install --quiet --dry-run --target build/none --only-binary :all: --require-hashes \
        --python-version $python --python-platform $machine-manylinux_2_36 -r .ci/requirements/$file.txt
    done
    echo "wheels: Python $python, $machine: each requirement of run.txt and test.txt has one"
  done
done

[ "$(id -u)" -eq 0 ] || { echo "arm64: needs root, for debootstrap and chroot" >&2; exit 1; }
formats=/proc/sys/fs/binfmt_misc
[ -e $formats/register ] || mount -t binfmt_misc binfmt_misc $formats
[ -e $formats/qemu-aarch64 ] || cat /usr/lib/binfmt.d/qemu-aarch64.conf >$formats/register

if [ ! -e "$root/complete" ]; then
  rm -rf "$root"
  archive=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | head -n 1)
  debootstrap --arch=arm64 --variant=minbase --include=ca-certificates bookworm "$root" "$archive"
  touch "$root/complete"
fi
cp /etc/resolv.conf /etc/hosts "$root/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
mkdir -p "$root/src"
find "$root/src" -mindepth 1 -maxdepth 1 ! -name .venv -exec rm -rf {} +
git archive HEAD | tar x -C "$root/src"

# The core of a Raspberry Pi 5. With QEMU's own default, OpenBLAS selects a kernel that raises false floating-point exceptions.
export QEMU_CPU=cortex-a76
export ASAN_OPTIONS=detect_leaks=0  # its leak checker traces processes, which QEMU cannot

inside() {
  unshare --mount --fork bash -c '
    for each in proc sys dev; do mount --rbind /$each "$1/$each"; done
    exec chroot "$1" env PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root bash -euc "cd /src; $2"' - "$root" "$1"
}
inside 'uname -m
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends python3-venv make git mosquitto procps systemd \
    gcc libc6-dev libmosquitto-dev libcbor-dev libcjson-dev \
    umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0 >/tmp/apt.log
  git init --quiet
  git add .
  make setup .venv/test-stamp'
inside '.venv/bin/resonatord demo --headless --plate quartz16 --seconds 10 --json' ||
  echo "arm64: the demo ended with $?; an emulated processor can be too slow for real time"
inside '.venv/bin/pytest --quiet --collect-only | grep :: | awk "NR % 10 == 1" >/tmp/tenth
  .venv/bin/pytest --numprocesses 2 -o faulthandler_timeout=600 @/tmp/tenth'
