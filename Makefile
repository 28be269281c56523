# Set-up, tests, demo and measurements of resonatord. `make` alone lists the targets.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-firmware test-browser test-schema test-ros2 test-lerobot test-notebook coverage bench bench-cost bench-details docs docs-check figures screenshots fuzz soak dist test-dist deb test-deb test-arm64 pins clean

# A user's PATH on Debian lacks the place of mosquitto.
export PATH := $(PATH):/usr/local/sbin:/usr/sbin

# pip-install TITLE ARGUMENTS: one line that names each package as it comes; pip's own words go to a log.
# requirements TITLE NAME...: installs those files of .ci/requirements. Without --no-deps, the pip of Python 3.11 takes the
# newest version of a package that a pinned one requires with an extra; that version has no hash there.
define pip-install
@pip-install() {
  printf 'setup: %s' "$$1"
  .venv/bin/python -m pip install --no-input --disable-pip-version-check --progress-bar off "$${@:2}" 2>&1 \
    | tee -a .venv/setup.log \
    | while read -r verb name _; do
        case "$$verb $$name" in
          "Collecting "*) printf ' %s' "$${name%%=*}" ;;
          "Processing "*.whl) name=$${name##*/}; printf ' %s' "$${name%%-*}" ;;
          "Installing collected") printf ', unpacking' ;;
        esac
      done || { printf '\n'; tail -n 15 .venv/setup.log; echo "setup: pip failed; see .venv/setup.log"; exit 1; } >&2
  printf '\n'
}
requirements() {
  pip-install "$$1" --no-deps --require-hashes $$(printf -- '-r .ci/requirements/%s.txt ' "$${@:2}")
  .venv/bin/python -m pip check --quiet --disable-pip-version-check >&2
}
endef

# What pip cannot bring: `debian-packages FILE:PACKAGE...`, each a command on PATH or a file with its whole name.
define debian-packages
@debian-packages() {
  local missing= wanted
  for wanted; do
    compgen -G "$${wanted%:*}" >/dev/null || command -v "$${wanted%:*}" >/dev/null || missing="$$missing $${wanted#*:}"
  done
  if [ -n "$$missing" ] && [ "$$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    echo "setup: Debian packages$$missing"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq || true
    apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=120 $$missing >.venv/apt.log 2>&1 \
      || { tail -n 15 .venv/apt.log; echo "setup: apt-get failed; see .venv/apt.log"; exit 1; } >&2
  elif [ -n "$$missing" ]; then
    echo "setup: missing:$$missing; as root: apt-get install$$missing" >&2
    exit 1
  fi
}
endef

BROKER := mosquitto:mosquitto
# Counts instructions.
COUNTER := valgrind:valgrind
SYSTEMD := systemd-analyze:systemd systemd-nspawn:systemd-container
# An emulated USB device, and the C reference beside the Python one.
USB := umockdev-run:umockdev /usr/lib/*/girepository-1.0/UMockdev-1.0.typelib:gir1.2-umockdev-1.0 \
  /usr/lib/python3/dist-packages/gi/__init__.py:python3-gi /usr/lib/*/libusb-1.0.so.0:libusb-1.0-0
COMPILER := gcc:gcc /usr/include/stdio.h:libc6-dev
# What programs in C subscribe and read payloads with.
EXAMPLES := /usr/include/mosquitto.h:libmosquitto-dev /usr/include/cbor.h:libcbor-dev /usr/include/cjson/cJSON.h:libcjson-dev
FIRMWARE := arm-none-eabi-gcc:gcc-arm-none-eabi qemu-system-arm:qemu-system-arm cmake:cmake g++:g++ \
  /usr/lib/arm-none-eabi/include/stdio.h:libnewlib-arm-none-eabi
BROWSER := chromium:chromium npm:npm
GENERATORS := node:nodejs npm:npm go:golang-go
FASTDDS := g++:g++ /usr/include/fastdds/dds/domain/DomainParticipant.hpp:libfastrtps-dev

help:  ## list the targets
	@sed -n 's/^\([a-z0-9-]*\):.*## /make \1\t/p' Makefile | expand -t 22

setup: .venv/run-stamp  ## leave .venv/bin/resonatord, from pinned and hashed packages; PYTHON=python3.13 selects another Python

demo: .venv/run-stamp  ## two emulated plates, a broker, the daemon and a live view
	@.venv/bin/resonatord demo || {
	  code=$$?
	  [ $$code -ne 1 ] || echo "make demo: something was lost or missed, as the lines above state; make reports it as Error 1" >&2
	  exit $$code
	}

test: .venv/test-stamp  ## linter, formatter check, type checker, import contracts and all tests
	$(debian-packages)
	debian-packages $(BROKER) $(SYSTEMD) $(USB) $(COMPILER) $(EXAMPLES)
	step() { printf '\n== %s\n' "$$*"; ".venv/bin/$$@"; }
	unset PYTHONDONTWRITEBYTECODE  # or each worker rewrites all tests
	.venv/bin/pytest --quiet --collect-only >.venv/collect.log 2>&1 &  # rewrites them once, meanwhile
	step ruff check
	step ruff format --check
	step mypy
	step lint-imports --no-logo
	export OMP_NUM_THREADS=1  # on a busy machine, threads that wait for each other cost minutes
	wait
	code=0
	step pytest --numprocesses 3 --dist worksteal || code=$$?  # neighbours, which share set-ups, stay together
	[ $$code -ne 0 ] || exit 0
	[ $$code -eq 1 ] || exit $$code  # not failed tests: pytest did not get through
	failed=$$(.venv/bin/pytest --quiet --collect-only --last-failed | grep ::)
	[ $$(wc -l <<<"$$failed") -le 10 ] || exit 1
	printf '\n== once more, alone: what failed among others\n'
	step pytest --last-failed
	sed 's/^/== failed among others, passed alone: /' <<<"$$failed"

test-firmware: .venv/test-stamp build/pico-sdk  ## the C reference under QEMU, the daemon against it; board programs for STM32 and RP2040 compiled
	$(debian-packages)
	debian-packages $(FIRMWARE)
	.venv/bin/pytest -m firmware tests/firmware
	.venv/bin/python benchmarks/firmware.py

test-browser: .venv/browser-stamp build/browser  ## the live page in Debian's chromium: panels, presses, recordings, phone width, accessibility
	$(debian-packages)
	debian-packages $(BROWSER)
	OMP_NUM_THREADS=1 .venv/bin/pytest -m 'browser and not soak' tests/extensions/live_page/browser

build/browser: tests/extensions/live_page/browser/package-lock.json  # axe-core, which checks accessibility
	$(debian-packages)
	debian-packages $(BROWSER)
	mkdir -p $@
	cp tests/extensions/live_page/browser/{package.json,package-lock.json,.npmrc} $@
	npm ci --prefix $@
	touch $@

screenshots: .venv/browser-stamp  ## pictures of the live page for README.md and docs/
	$(debian-packages)
	debian-packages $(BROKER) $(BROWSER)
	.venv/bin/python docs/figures/screenshots.py

test-schema: .venv/test-stamp  ## types that modelina and json-schema-to-typescript make of the AsyncAPI document, compiled and used
	$(debian-packages)
	debian-packages $(GENERATORS)
	node -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)' || { echo "needs Node.js 20 or newer; found $$(node --version)" >&2; exit 1; }
	mkdir -p build/generators
	cd build/generators
	if ! cmp -s ../../tests/generators/package-lock.json package-lock.json || [ ! -e node_modules/.package-lock.json ]; then
	  cp ../../tests/generators/{package.json,package-lock.json,.npmrc} .
	  npm ci
	fi
	cd ../..
	.venv/bin/pytest -m generators tests/generators

test-ros2: .venv/test-stamp build/fastdds_reader  ## the bridge to ROS 2, read by Debian's Fast DDS in C++, with the list of nodes of Humble and of later versions
	$(debian-packages)
	debian-packages $(BROKER)
	OMP_NUM_THREADS=1 .venv/bin/pytest -m fastdds tests/extensions/ros2

build/fastdds_reader: tests/extensions/ros2/fastdds_reader.cpp
	$(debian-packages)
	debian-packages $(FASTDDS)
	mkdir -p build
	g++ -std=c++17 -O1 -Wall -Wextra -Werror $< -lfastrtps -lfastcdr -o $@

PICO_SDK := @xpack-3rd-party/raspberrypi-pico-sdk@2.3.0-5
PICO_SDK_SHA512 := 082f30dac4285ddd422b075311c73d636cbc9fe0cf6a43413d940998f8b1d99e461e26cf42aaf491f26c3bd50a08c5403fa57ed1881fccef37dc3062688ff73d

build/pico-sdk:  # the Pico SDK as an npm package, without TinyUSB; PICO_SDK_PATH names another. Without either its tests are skipped
	@[ -n "$${PICO_SDK_PATH:-}" ] && exit 0
	mkdir -p build
	cd build
	archive=$$(npm pack --silent $(PICO_SDK) 2>/dev/null) || { echo "no Pico SDK: npm is missing or cannot fetch $(PICO_SDK)" >&2; exit 0; }
	echo "$(PICO_SDK_SHA512)  $$archive" | sha512sum --check --quiet
	tar xzf "$$archive"
	mv package pico-sdk
	rm "$$archive"

test-lerobot: .venv/test-stamp build/lerobot  ## exported datasets, each frame read by LeRobot's own loader; installs torch, 8 GB
	OMP_NUM_THREADS=1 .venv/bin/pytest -o faulthandler_timeout=900 -m lerobot tests/extensions/lerobot

build/lerobot: .ci/requirements/lerobot.txt  # in an environment of its own
	rm -rf $@.part $@
	.venv/bin/python -m venv $@.part
	$@.part/bin/pip install --quiet --no-deps --require-hashes -r $<
	mv $@.part $@

test-notebook: .venv/notebook-stamp  ## the notebook that predicts slips, executed: presses, export, training; 2 minutes
	OMP_NUM_THREADS=1 .venv/bin/pytest -o faulthandler_timeout=900 -m notebook tests/test_notebooks.py

coverage: .venv/test-stamp  ## all tests, more slowly, and the branches that they do not reach
	$(debian-packages)
	debian-packages $(BROKER) $(SYSTEMD) $(USB) $(COMPILER) $(EXAMPLES)
	export OMP_NUM_THREADS=1
	.venv/bin/pytest --cov --numprocesses 2

bench: .venv/run-stamp  ## processor time of each stage compared with a record, 6 minutes; RECORD=--record renews the record
	$(debian-packages)
	debian-packages $(BROKER) $(COUNTER)
	OMP_NUM_THREADS=1 .venv/bin/python benchmarks/stages.py $(RECORD)

bench-cost: .venv/run-stamp  ## instructions of each stage, compared with its record, 3 minutes; fails if one exceeds it by more than 10 %
	$(debian-packages)
	debian-packages $(BROKER) $(COUNTER)
	.venv/bin/python benchmarks/stages.py --count

BASELINE ?=

bench-details: .venv/test-stamp  ## whole processes, latency, overload, decoders, page, fleet, half an hour; BASELINE=DIR measures another checkout in turns
	$(debian-packages)
	debian-packages $(BROKER)
	run() { printf '\n== %s\n' "$$*"; .venv/bin/python benchmarks/"$$@"; }
	run system_cost.py demo
	run system_cost.py daemon $(addprefix --baseline ,$(BASELINE))
	run system_cost.py daemon --plate skin32 --rate 250 --seconds 60 --turns 1
	run latency.py
	run system_cost.py replay
	run system_cost.py decode-recordings
	for plate in quartz16 skin32; do run overload.py --plate $$plate || true; done
	export OMP_NUM_THREADS=1  # threads that wait for each other would be timed
	for figure in errors model frame set-up; do run decoding.py $$figure; done
	run live_page.py relay
	run fleet.py

figures: .venv/figures-stamp  ## draw the pictures of README.md and docs/ again
	@export OMP_NUM_THREADS=1
	.venv/bin/python docs/figures/draw.py
	.venv/bin/python docs/figures/fingertip.py
	.venv/bin/python docs/figures/diagrams.py
	.venv/bin/python docs/figures/press.py

docs: .venv/docs-stamp  ## the documentation as a site with search, in build/site; each link is checked
	@.venv/bin/python docs/site/stage.py build/site-source
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --config-file docs/site/mkdocs.yml
	echo "open build/site/index.html"

dist: .venv/dist-stamp  ## wheel, source archive and bill of materials of the present commit in dist/, reproducibly
	@.venv/bin/python .ci/make_dist.py

test-dist: .venv/test-stamp .venv/dist-stamp  ## two builds compared; every command from the wheel alone, in an empty environment
	$(debian-packages)
	debian-packages $(BROKER) faketime:faketime git:git
	.venv/bin/pytest -o faulthandler_timeout=900 -m distribution tests/distribution/test_dist.py

ARCH ?= amd64

deb: dist  ## the Debian package in dist/, with its pinned Python packages; ARCH=arm64 for another processor
	$(debian-packages)
	debian-packages dh:debhelper dpkg-buildpackage:dpkg-dev fakeroot:fakeroot
	rm -f dist/resonatord_*_$(ARCH).deb
	.ci/make_deb.sh $(ARCH)

test-deb: deb build/debian  ## lintian; the package built twice and compared; installed, upgraded, rolled back, removed and purged under systemd
	$(debian-packages)
	debian-packages lintian:lintian systemd-nspawn:systemd-container faketime:faketime git:git
	lintian --fail-on error,warning --tag-display-limit 0 dist/resonatord_*_$(ARCH).deb
	tests/distribution/test_deb.sh dist/resonatord_*_$(ARCH).deb

test-arm64: .venv/run-stamp  ## wheels for each Python and processor; set-up, a demo and a tenth of the tests on an emulated arm64
	$(debian-packages)
	debian-packages debootstrap:debootstrap qemu-aarch64-static:qemu-user-static
	$(pip-install)
	requirements "uv" pins
	tests/distribution/arm64.sh

# Packages of an installed Debian 12; the archive is the one that this computer's apt uses.
DEBIAN_ROOT := systemd,systemd-sysv,dbus,udev,python3,libusb-1.0-0,mosquitto,mosquitto-clients,procps

build/debian:
	$(debian-packages)
	debian-packages debootstrap:debootstrap
	mkdir -p build
	archive=$$(apt-get indextargets --format '$$(REPO_URI)' 'Created-By: Packages' | head -n 1)
	rm -rf $@.part
	debootstrap --variant=minbase --include=$(DEBIAN_ROOT) bookworm $@.part "$$archive" >build/debootstrap.log
	mv $@.part $@

DOCS_TOOLS := mosquitto_sub:mosquitto-clients jq:jq socat:socat unshare:util-linux openssl:openssl

docs-check: .venv/test-stamp docs  ## links, generated pages, sentences; then each command and program of the pages; PAGES=docs/how-to/record.md
	$(debian-packages)
	debian-packages $(BROKER) $(DOCS_TOOLS) $(COMPILER) $(EXAMPLES)
	export OMP_NUM_THREADS=1
	.venv/bin/pytest --quiet tests/test_documentation.py
	.venv/bin/python docs/site/run_pages.py $(PAGES)

fuzz: .venv/run-stamp  ## ten million inputs through each parser of the wire, in Python and in C; a million commands
	$(debian-packages)
	debian-packages $(COMPILER)
	mkdir -p build
	gcc -std=c99 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -I firmware_protocol/c \
	  firmware_protocol/c/fuzz/fuzz.c firmware_protocol/c/resonator_*.c -o build/fuzz
	build/fuzz 10000000 1
	.venv/bin/python benchmarks/fuzz.py wire
	.venv/bin/python benchmarks/fuzz.py commands

MINUTES ?= 60

soak: .venv/test-stamp  ## MINUTES=60 of faults; a simulated year; brokers frozen, dead, slow; kills and restores; hang-ups; damaged frames; long tests
	$(debian-packages)
	debian-packages $(BROKER)
	run() { printf '\n== %s\n' "$$*"; .venv/bin/python benchmarks/"$$@"; }
	run long_run.py --minutes $(MINUTES)
	run year.py
	run outages.py
	for part in orders recorders hang-ups; do run kills.py $$part; done
	run power_failure.py
	run wire_accounts.py
	run gripper.py
	printf '\n== long tests\n'
	OMP_NUM_THREADS=1 .venv/bin/pytest -m 'soak and not browser'
	$(MAKE) build/browser .venv/browser-stamp
	.venv/bin/pytest -o faulthandler_timeout=900 -m 'soak and browser' tests/extensions/live_page/browser

pins: .venv/run-stamp  ## write .ci/requirements/*.txt from pyproject.toml
	$(pip-install)
	requirements "uv" pins
	compile() {
	  .venv/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --fork-strategy fewest \
	    --generate-hashes --no-annotate --no-emit-index-url --custom-compile-command 'make pins' "$$@"
	}
	build_requires='import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")'
	.venv/bin/python -c "$$build_requires" | compile - --output-file .ci/requirements/build.txt
	compile pyproject.toml --extra demo --output-file .ci/requirements/run.txt
	compile pyproject.toml --extra demo --extra figures --output-file .ci/requirements/figures.txt
	compile pyproject.toml --extra demo --extra docs --output-file .ci/requirements/docs.txt
	compile pyproject.toml --extra demo --extra figures --extra test --output-file .ci/requirements/test.txt
	compile pyproject.toml --extra demo --extra figures --extra test --extra browser --output-file .ci/requirements/browser.txt
	compile pyproject.toml --extra demo --extra figures --extra test --extra notebook --output-file .ci/requirements/notebook.txt
	compile pyproject.toml --extra demo --group dist --output-file .ci/requirements/dist.txt
	compile --group lerobot --output-file .ci/requirements/lerobot.txt
	compile --group pins --output-file .ci/requirements/pins.txt

clean:  ## remove everything that the other targets made
	@rm -rf .venv build dist *.egg-info .coverage .coverage.* .hypothesis .import_linter_cache .mypy_cache \
	  .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The environment: PYTHON, or the first Python that is new enough and can make one. An interrupted attempt is begun again;
# so is one with another version than PYTHON.
PYTHONS := $(or $(PYTHON),python3 python3.14 python3.13 python3.12 python3.11)
ifneq ($(PYTHON),)
ifneq ($(shell $(PYTHON) --version 2>&1),$(shell [ ! -x .venv/bin/python ] || .venv/bin/python --version))
.PHONY: .venv/bin/python .venv/bin/pip
endif
endif
.venv/bin/python .venv/bin/pip &:
	@unfit="no Python"
	for python in $(PYTHONS); do
	  version=$$("$$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue
	  if ! "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
	    unfit="Python $$version"
	  elif ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then
	    unfit="Python $$version without venv"
	  else
	    echo "setup: .venv with Python $$version"
	    exec "$$python" -m venv --clear .venv
	  fi
	done
	echo "setup: needs Python 3.11 or newer with venv; found $$unfit. On Debian 12 or newer, as root: apt-get install python3-venv" >&2
	exit 1

# An editable install alone would find any folder called resonatord, as this checkout's, before the package.
PATH_FILE := from pathlib import Path; from sysconfig import get_path; \
  Path(get_path('purelib'), 'resonatord.pth').write_text(str(Path('resonator_daemon/tools/python_api/import_name').absolute()))

.venv/run-stamp: .venv/bin/python .venv/bin/pip pyproject.toml .ci/requirements/build.txt .ci/requirements/run.txt
	$(pip-install)
	requirements "packages" build run
	pip-install "resonatord itself" --no-deps --no-build-isolation --editable .
	.venv/bin/python -c "$(PATH_FILE)"
	echo 'setup: done, see .venv/bin/resonatord --help'
	touch $@

.venv/figures-stamp: .venv/run-stamp .ci/requirements/figures.txt
	$(pip-install)
	requirements "packages for pictures" figures
	touch $@

.venv/dist-stamp: .venv/run-stamp .ci/requirements/dist.txt
	$(pip-install)
	requirements "packages for distribution" dist
	touch $@

.venv/docs-stamp: .venv/run-stamp .ci/requirements/docs.txt
	$(pip-install)
	requirements "packages for documentation" docs
	touch $@

.venv/test-stamp: .venv/run-stamp .ci/requirements/test.txt
	$(pip-install)
	requirements "packages for tests" test
	touch $@

.venv/notebook-stamp: .venv/test-stamp .ci/requirements/notebook.txt
	$(pip-install)
	requirements "packages for the notebook" notebook
	touch $@

.venv/browser-stamp: .venv/test-stamp .ci/requirements/browser.txt
	$(pip-install)
	requirements "packages for tests in a browser" browser
	touch $@
