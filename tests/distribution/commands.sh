#!/bin/bash
# Run every command of the resonatord on PATH in $1, an empty directory outside the checkout, with an emulated board and a broker.
set -euxo pipefail
cd "$1"
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
wait_for() { for _ in $(seq 600); do if "$@"; then return; fi; sleep 0.1; done; echo "never: $*" >&2; return 1; }
free_port() { "$python" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'; }
# A busy computer is slow: what is asked is that the command measures and ends by itself.
or_late() { "$@" || [ $? -eq 1 ]; }
python=$(dirname "$(readlink -f "$(command -v resonatord)")")/python
port=$(free_port)
url=mqtt://127.0.0.1:$port

"$python" -c 'import resonator_daemon, sys; print(resonator_daemon.__file__, file=sys.stderr)'
"$python" -c 'import resonatord; print(*sorted(resonatord.__all__), resonatord.load_recording, resonatord.subscribe)'
"$python" -c 'from resonator_daemon.commands._command_line import command_names; print(*command_names(), sep="\n")' >names
while read -r -a words; do resonatord "${words[@]}" --help >help.txt; test -s help.txt; done <names
resonatord --version

mosquitto -p "$port" 2>/dev/null &
resonatord emulate --plate quartz16 --scenario still --pty board &
wait_for test -e board
link="serial:$PWD/board?baud=4000000"
resonatord config example | sed -e "s#^link = .*#link = \"$link\"#" -e "s#^url = \"[^\"]*\"#url = \"$url\"#" >left.toml
resonatord check left.toml
resonatord config explain mqtt.url
resonatord config schema >schema.json
resonatord schema >asyncapi.json
"$python" -m json.tool asyncapi.json >/dev/null
resonatord ports --json
resonatord identify "$link"
resonatord record left.toml --output run.mcap --seconds 2
or_late resonatord doctor left.toml --seconds 2 --json

resonatord replay run.mcap --to run.jsonl
resonatord export run.mcap --format csv --topics forces --output run.csv
resonatord compare run.mcap run.mcap
resonatord repair run.mcap
resonatord plan codes --grid 2x2 --pitch-mm 5 --force-max-newton 10 --output plate.toml
resonatord plan sensors --set p_n --depth-mm 1 --pitch-mm 0.4 --snr-db 30
resonatord install --dry-run
resonatord install --prefix image
resonatord uninstall --prefix image

resonatord run left.toml &
daemon=$!
wait_for sh -c "resonatord status left-index --json | grep -q '\"online\"'"
resonatord status left-index
resonatord reload left-index
resonatord command left-index tare --url "$url"
resonatord tare left.toml
timeout --preserve-status --signal=INT 3 resonatord watch --url "$url" >watch.txt
for source in "--url $url" run.mcap; do
  # shellcheck disable=SC2086
  resonatord view $source --listen 127.0.0.1:0 --json >page.json &
  page=$!
  wait_for grep -q url page.json
  "$python" - <<'READ'
import json, urllib.request
page = json.loads(open("page.json").readline())["url"]
for name in ("", "main.js", "style.css", "uplot/uPlot.iife.min.js", "three/three.module.min.js"):
    assert urllib.request.urlopen(page + name).status == 200
READ
  kill -INT $page
  wait $page
done
kill -INT $daemon
wait $daemon

sed -e 's#^plate = .*#plate = "skin32"#' -e 's#^\[decoding\]#&\nexternal = true#' left.toml >skin.toml
timeout --preserve-status --signal=INT 4 resonatord decode skin.toml
or_late resonatord demo --headless --seconds 5 --json >demo.json
"$python" -c 'import json; assert all(plate["frames"] > 100 for plate in json.load(open("demo.json"))["plates"].values())'
