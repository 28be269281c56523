// A recording's position, speed and marks; and commands to the daemon of a live plate.

import { UNKNOWN, fixed, make, setText } from "./text.js";

export class RecordingPanel {
  #isDragging = false;

  constructor(root, source, connection, onSeek) {
    this.root = root;
    this.source = source;
    this.connection = connection;
    this.position = { t_s: 0, playing: false, speed: 1 };
    this.bar = root.querySelector("input[type=range]");
    this.button = root.querySelector(".play");
    this.speed = root.querySelector("select");
    this.together = root.querySelector(".together");
    this.partners = [];
    this.bar.step = 0.01;
    this.button.addEventListener("click", () => this.#play(!this.position.playing));
    this.speed.addEventListener("change", () => this.#play(this.position.playing));
    this.bar.addEventListener("input", () => {
      this.#isDragging = true;
      this.#seek(Number(this.bar.value));
    });
    this.bar.addEventListener("change", () => (this.#isDragging = false));
    this.onSeek = onSeek;
    this.setSource(source);
  }

  /** File, duration and marks: the last two are known only when the server has read the whole file. */
  setSource(source) {
    this.source = source;
    setText(this.root.querySelector("h3"), `Recording ${source.source.toUpperCase()}: ${source.file ?? UNKNOWN}`);
    this.bar.max = source.duration_s > 0 ? source.duration_s : 1;
    const marks = Array.isArray(source.marks) ? source.marks : [];
    this.root.querySelector(".marks").replaceChildren(
      ...marks.map(({ t_s, label }) => {
        const button = make("button", "", `${fixed(t_s, 1)} s ${label ?? ""}`);
        button.type = "button";
        button.addEventListener("click", () => this.#seek(t_s));
        return button;
      }),
    );
    setText(this.root.querySelector(".failure"), source.failure ? `Nothing of it can be shown: ${source.failure}` : "");
    this.root.querySelector(".player").hidden = Boolean(source.failure);
    this.#show();
  }

  #group() {
    return [this, ...(this.together.checked ? this.partners : [])];
  }

  #play(isPlaying) {
    if (isPlaying && this.position.ended) this.#seek(0);
    const speed = Number(this.speed.value);
    for (const { source } of this.#group()) this.connection.send({ play: { source: source.source, playing: isPlaying, speed } });
  }

  #seek(t_s) {
    for (const panel of this.#group()) {
      panel.onSeek();
      this.connection.send({ seek: { source: panel.source.source, t_s: Math.min(t_s, panel.source.duration_s ?? t_s) } });
    }
  }

  setPosition(position) {
    this.position = position;
    this.#show();
  }

  #show() {
    const { t_s, playing, speed, ended, truncated, decoded_s } = this.position;
    const isBehind = playing && !ended && t_s >= decoded_s;
    if (!this.#isDragging && Number.isFinite(t_s)) this.bar.value = t_s;
    const { duration_s } = this.source;
    const time = `${fixed(t_s, 1)}${Number.isFinite(duration_s) ? ` of ${fixed(duration_s, 1)}` : ""} s`;
    this.bar.setAttribute("aria-valuetext", time);
    setText(this.root.querySelector(".time"), ended ? `${time}, ended` : isBehind ? `${time}, waits for decoding` : time);
    setText(this.button, playing ? "Pause" : "Play");
    if (Number.isFinite(speed) && document.activeElement !== this.speed) this.speed.value = String(speed);
    setText(this.root.querySelector(".truncated"), truncated ? `Incomplete: ${truncated}` : "");
  }
}

const DONE = { tare: "Tared.", mark: "Mark written.", start_recording: "Recording started.", stop_recording: "Recording stopped." };

export class CommandPanel {
  constructor(root, connection, announce) {
    this.root = root;
    this.connection = connection;
    this.announce = announce;
    this.plate = null;
    root.querySelector(".tare").addEventListener("click", () => this.#send("tare", {}));
    root.querySelector(".record").addEventListener("click", () => this.#send(this.isRecording ? "stop_recording" : "start_recording", {}));
    root.querySelector("form").addEventListener("submit", (event) => {
      event.preventDefault();
      const input = root.querySelector("input");
      const text = input.value.trim();
      if (text) return this.#send("mark", { text }).then((ok) => ok && (input.value = ""));
      this.#report("Enter the text of the mark first.");
      input.focus();
    });
  }

  /** Enable the verbs that both the server and the daemon permit. */
  describe(plate, permitted, model) {
    this.plate = plate;
    this.isRecording = Boolean(model?.health?.recording.file);
    const can = (verb) => permitted.includes(verb) && (model?.info?.commands ?? []).includes(verb);
    const record = this.isRecording ? "stop_recording" : "start_recording";
    setText(this.root.querySelector(".record"), this.isRecording ? "Stop recording" : "Record");
    for (const [selector, verb] of [[".tare", "tare"], [".record", record], [".mark", "mark"]]) {
      const button = this.root.querySelector(selector);
      if (button.disabled === can(verb)) button.disabled = !can(verb);
      button.title = can(verb) ? "" : "[commands] allow of the daemon does not list it";
    }
    this.root.hidden = !permitted.length;
  }

  async #send(verb, args) {
    const answer = await this.connection.request({ command: { plate: this.plate, verb, arguments: args } });
    const text = answer.ok ? answer.message || DONE[verb] : `Refused: ${answer.error?.message ?? "no reason given"}`;
    this.#report(text);
    return answer.ok;
  }

  #report(text) {
    setText(this.root.querySelector("output"), text);
    this.announce(text);
  }
}
