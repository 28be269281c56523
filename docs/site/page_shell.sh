# What the comments of pages may call besides commands: a board and a daemon as a reader has them.

# board [PLATE [OPTION...]]: an emulated board at /tmp/board, of a skin at a TCP port, and left-index.toml for it.
board() {
  local carrier="--pty /tmp/board"
  if [ "${1:-}" = skin32 ]; then carrier="--tcp 127.0.0.1:7000"; fi
  # shellcheck disable=SC2086
  resonatord emulate --plate "${1:-quartz16}" $carrier --seed 3 "${@:2}" >/tmp/board.log 2>&1 &
  await 'grep -q emulating /tmp/board.log'
  resonatord config example >left-index.toml
  link
  if [ "${1:-}" = skin32 ]; then sed -i 's|^link = .*|link = "tcp://127.0.0.1:7000"|' left-index.toml; fi
  sed -i "s|^plate = .*|plate = \"${1:-quartz16}\"|; s|^allow = .*|allow = [\"start_recording\", \"stop_recording\", \"mark\", \"tare\", \"set_window\"]|" left-index.toml
}

# link [FILE]: enter the emulated board's link, as the pages ask for.
link() { sed -i 's|^link = .*|link = "serial:/tmp/board?baud=4000000"|' "${1:-left-index.toml}"; }

# daemon: run the daemon of left-index.toml until it measures.
daemon() {
  resonatord run left-index.toml >/tmp/daemon.log 2>&1 &
  await 'grep -q "sensor online" /tmp/daemon.log'
}

# recording [NAME...]: 5 s of touches with the mark "lifted", under each of these names.
recording() {
  daemon
  file=$(resonatord command left-index.toml start_recording --json | jq -r .file)
  sleep 2
  resonatord command left-index.toml mark text=lifted
  sleep 3
  resonatord command left-index.toml stop_recording
  for name; do mkdir -p "$(dirname "$name")" && cp "$file" "$name"; done
  kill %%
  wait %%
}

# await CONDITION: at most 30 s.
await() {
  for _ in $(seq 600); do
    if eval "$1"; then return 0; fi
    sleep 0.05
  done
  echo "never: $1" >&2
  return 1
}
