#!/bin/bash
# Where pages are run there is no systemd: this starts the program that the unit would; tests/systemd boots a real one.
case "$*" in
  "enable --now "* | "restart "*)
    pkill -f 'resonatord run /etc' # all processes here are the page's own
    for file in /etc/resonatord/left-index.toml; do
      setsid /opt/resonatord/bin/resonatord run "$file" >/tmp/daemon.log 2>&1 &
    done
    for _ in $(seq 400); do grep -q 'link ' /tmp/daemon.log && exit 0; sleep 0.05; done
    exit 1
    ;;
esac
