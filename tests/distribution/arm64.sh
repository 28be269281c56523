#!/usr/bin/env bash
# The product on arm64, in a Debian root under user-mode emulation: set-up, a demo, and a tenth of the tests. Needs root.
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

# 1000 frames/s, as of the plate, are too many for an emulated processor: the demo has 200, and no skin.
demo=passed
inside 'plate=resonator_daemon/base/plates/quartz16-slow.toml
  sed -e "s/^frame_rate_hz = 1000/frame_rate_hz = 200/" -e "s/^name = .*/name = \"quartz16-slow\"/" resonator_daemon/base/plates/quartz16.toml >$plate
  trap "rm $plate" EXIT
  .venv/bin/resonatord demo --headless --plate quartz16-slow --seconds 10 --json' || demo="failed, exit code $?"

# Tests of an emulated board in real time are left out, for the same reason. What fails is run once more, one after the other.
tests=passed
inside 'real_time=$(grep -rlE "^ *from (emulation|service_bench|documented_commands) " tests --include="test_*.py")
  .venv/bin/pytest --quiet --collect-only | grep :: >/tmp/all
  grep -vF "$real_time" /tmp/all | grep -vE "^tests/(daemon|demo)/" >/tmp/without_board
  echo "arm64: every tenth of $(wc -l </tmp/without_board) tests; $(wc -l </tmp/all) with those that need a board in real time"
  awk "NR % 10 == 1" /tmp/without_board >/tmp/tenth
  .venv/bin/pytest --numprocesses 2 -o faulthandler_timeout=600 @/tmp/tenth ||
    { [ $? -eq 1 ]; .venv/bin/pytest --last-failed -o faulthandler_timeout=600; }' || tests="failed, exit code $?"
echo "arm64: set-up passed; demo $demo; tests $tests"
[ "$demo $tests" = "passed passed" ]
