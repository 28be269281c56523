// Starts the page: one connection, the plates that publish, a view for each source, and the drawing loop.

import { startTheme } from "./colours.js";
import { Connection } from "./connection.js";
import { Library } from "./library.js";
import { readTruth, seconds } from "./payloads.js";
import { PlateModel } from "./plate_model.js";
import { UNKNOWN, make, setText, sinceTime } from "./text.js";
import { View } from "./view.js";

const TEXT_PERIOD_MS = 200;
const LIVE = { source: "live", url: "" };

class App {
  constructor() {
    this.models = new Map();
    this.views = [];
    this.hello = { sources: [], commands: [], press: [], directory: null };
    this.page = { clients: 1, skipped: 0 };
    this.broker = { connected: true };
    this.link = { state: "connecting", since: Date.now() / 1000 };
    this.draws = 0;
    const address = new URL("ws", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.hash = "";
    this.connection = new Connection(address.href, {
      payload: (source, plate, path, bytes) => this.model(source, plate).receive(path, bytes, performance.now()),
      message: (key, content) => this.#receive(key, content),
      state: (state) => this.#setLink(state),
    });
    this.library = new Library(document.querySelector("#library"), this.connection, (text) => this.announce(text));
    document.addEventListener("visibilitychange", () => this.views.forEach((view) => view.watch()));
    requestAnimationFrame((now) => this.#frame(now));
  }

  get hasBroker() {
    return this.broker.connected !== false;
  }

  get isOpen() {
    return this.link.state === "open";
  }

  model(source, plate) {
    const key = `${source}/${plate}`;
    if (!this.models.has(key)) this.models.set(key, new PlateModel(source, plate));
    return this.models.get(key);
  }

  /** Names of a source's plates that publish anything, sorted. */
  plates(source) {
    const found = [...this.models.values()].filter((model) => model.source === source && (model.info || model.states.daemon || model.arrived > -Infinity));
    return found.map(({ name }) => name).sort();
  }

  /** The plate to begin with: of the address, else one that can be pressed and has a map, else the first. */
  preferred(names) {
    const wanted = decodeURIComponent(location.hash.slice(1));
    const skin = names.find((name) => this.hello.press.includes(name) && this.model("live", name).isSkin);
    return names.includes(wanted) ? wanted : (skin ?? names.find((name) => this.hello.press.includes(name)) ?? names[0]);
  }

  announce(text) {
    setText(document.querySelector("#announcements"), text);
  }

  #setLink(state) {
    const isSame = (state === "open") === this.isOpen;
    this.link = { state, since: isSame ? this.link.since : Date.now() / 1000 };
    if (state === "open") {
      this.views.forEach((view) => view.watch());
      this.library.reopen();
    }
    if (state === "closed") this.views.forEach((view) => view.presser.releaseAll());
  }

  #receive(key, content) {
    if (key === "hello") this.#setHello(content);
    else if (key === "broker") this.broker = { ...content, since: seconds(content.since_t_ns) };
    else if (key === "clients") this.page = { clients: content.count ?? 1, skipped: content.skipped ?? 0 };
    else if (key === "truth") {
      const truth = readTruth(content);
      if (truth.plate) this.model("live", truth.plate).addTruth(truth);
    } else if (key === "position") {
      this.views.find(({ source }) => source.source === content.source)?.recording?.setPosition(content);
    }
  }

  #setHello({ sources, commands, press, directory }) {
    const known = (Array.isArray(sources) ? sources : []).filter((source) => typeof source?.source === "string");
    const list = (value) => (Array.isArray(value) ? value : []);
    const served = typeof directory === "string" ? directory : null;
    this.hello = { sources: known.length || served !== null ? known : [LIVE], commands: list(commands), press: list(press), directory: served };
    this.library.describe(served, known);
    const key = this.hello.sources.map(({ source, file, url, opening }) => `${source} ${file} ${url} ${opening}`).join("\n");
    if (key === this.sourceKey) {
      for (const view of this.views) {
        const source = this.hello.sources.find((other) => other.source === view.source.source);
        view.source = source;
        view.recording?.setSource(source);
      }
    } else {
      this.sourceKey = key;
      for (const [name, { source }] of this.models) if (source !== "live") this.models.delete(name);
      const recordings = this.hello.sources.filter(({ source }) => source !== "live");
      this.#show(recordings.length ? recordings : this.hello.sources);
    }
    this.views.forEach((view) => view.watch());
  }

  /** Show these sources side by side, with buttons for all of them. */
  #show(shown) {
    this.views.forEach((view) => view.remove());
    this.views = shown.map((source) => new View(source, this));
    const panels = this.views.map(({ recording }) => recording).filter(Boolean);
    for (const panel of panels) {
      panel.partners = panels.filter((other) => other !== panel);
      panel.root.querySelector(".together-label").hidden = panels.length < 2;
    }
    document.body.dataset.views = this.views.length;
    const nav = document.querySelector("#sources");
    nav.hidden = this.hello.sources.length < 2;
    nav.replaceChildren(
      ...this.hello.sources.map((source) => {
        const button = make("button", "", source.source === "live" ? "Live" : `${source.source.toUpperCase()}: ${source.file ?? UNKNOWN}`);
        const isShown = shown.some((other) => other.source === source.source);
        button.type = "button";
        button.setAttribute("aria-pressed", isShown);
        button.addEventListener("click", () => {
          const isIn = (other) => this.views.some((view) => view.source.source === other.source);
          const next = this.hello.sources.filter((other) => isIn(other) !== (other.source === source.source));
          if (next.length) this.#show(next);
        });
        return button;
      }),
    );
  }

  #frame(nowMs) {
    requestAnimationFrame((now) => this.#frame(now));
    for (const view of this.views) this.draws += view.draw(nowMs);
    if (nowMs - (this.describedMs ?? 0) < TEXT_PERIOD_MS) return;
    this.describedMs = nowMs;
    this.#describe();
    for (const view of this.views) view.describe(nowMs);
  }

  #describe() {
    const notice = document.querySelector("#notice");
    let text = "";
    if (this.views.some(({ model }) => model)) text = ""; // its headline says it
    else if (!this.isOpen && !this.sourceKey) text = "Connecting…";
    else if (!this.isOpen) text = `No connection to the page's server ${sinceTime(this.link.since)}; trying again.`;
    else if (!this.hasBroker && this.views.some(({ isLive }) => isLive)) {
      const reason = this.broker.reason || this.broker.reason_code || "no reason given";
      text = `No connection to the MQTT broker ${sinceTime(this.broker.since)} (${reason}); trying again. --url of resonatord view selects another broker.`;
    }
    setText(notice, text);
    notice.hidden = !text;
    const live = this.hello.sources.find(({ source }) => source === "live");
    setText(document.querySelector("#address"), live?.url ?? "");
  }
}

startTheme();
window.resonatord = new App();
