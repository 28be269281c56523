// One source's plate on the page: its panels, which plate is chosen, and what is drawn when.

import { ContactsPanel } from "./contacts.js";
import { HealthPanel } from "./health.js";
import { PlatePanel } from "./plate.js";
import { STREAMS } from "./plate_model.js";
import { Presser } from "./press.js";
import { CommandPanel, RecordingPanel } from "./recordings.js";
import { situation } from "./situation.js";
import { SurfacePanel } from "./surface.js";
import { duration, make, setText } from "./text.js";

export class View {
  constructor(source, app) {
    this.source = source;
    this.app = app;
    this.root = document.querySelector("#view").content.firstElementChild.cloneNode(true);
    document.querySelector("main").append(this.root);
    const part = (name) => this.root.querySelector(`.${name}`);
    this.isLive = source.source === "live";
    this.name = this.isLive ? "Live" : `Recording ${source.source.toUpperCase()}`;
    this.root.setAttribute("aria-label", this.name);
    setText(part("source"), this.name);
    part("source").classList.toggle("hidden-text", this.isLive);
    this.tabs = part("plates");
    this.plate = new PlatePanel(part("plate-panel"), part("identification"));
    this.surface = new SurfacePanel(part("surface-panel"));
    this.contacts = new ContactsPanel(part("contacts-panel"));
    this.health = new HealthPanel(part("health-panel"), part("situation"));
    const announce = (text) => app.announce(text);
    this.presser = new Presser(app.connection, part("press-output"), announce);
    for (const scene of [this.plate.scene, this.surface.scene, this.surface.relief]) this.presser.attach(scene);
    this.commands = this.isLive ? new CommandPanel(part("command-panel"), app.connection, announce) : null;
    part("command-panel").hidden = !this.isLive;
    part("recording-panel").hidden = this.isLive;
    this.recording = this.isLive ? null : new RecordingPanel(part("recording-panel"), source, app.connection, () => this.model?.clearPast());
    this.model = null;
    this.selected = null;
  }

  remove() {
    this.presser.releaseAll();
    this.surface.relief.remove();
    this.root.remove();
  }

  /** Show a plate: its model is kept by the page, which asks the server for its streams. */
  select(name) {
    this.selected = name;
    this.model = this.app.model(this.source.source, name);
    this.infoVersion = -1;
    this.watch();
  }

  watch() {
    const topics = document.hidden ? [] : STREAMS;
    if (this.selected) this.app.connection.send({ watch: { source: this.source.source, plate: this.selected, topics } });
  }

  #setInfo() {
    const { model, root } = this;
    this.infoVersion = model.infoVersion;
    this.plate.setInfo(model.info);
    this.surface.setInfo(model.info);
    root.dataset.sensor = model.isSkin ? "skin" : "sites";
  }

  #pressable() {
    return this.isLive && this.app.hello.press.includes(this.selected) && this.app.isOpen;
  }

  /** Draw the newest frame, if anything changed since the last one. Returns the number of canvases drawn. */
  draw(nowMs) {
    const { model, presser } = this;
    if (!model) return 0;
    if (this.infoVersion !== model.infoVersion) this.#setInfo();
    presser.setPlate(this.#pressable() ? this.selected : null, model.info);
    presser.advance(nowMs);
    model.sample();
    const panel = model.isSkin ? this.surface : this.plate;
    const isChanged = this.drawnVersion !== model.version || this.drawnModel !== model || presser.isActive || presser.isMoved;
    this.drawnVersion = model.version;
    this.drawnModel = model;
    presser.isMoved = false;
    if (!isChanged && !panel.scene.changed) return 0;
    panel.draw(model, presser.marks());
    return 1;
  }

  /** Text, a few times a second. */
  describe(nowMs) {
    this.#describeTabs();
    const { model, root } = this;
    // Messages of recordings keep their times: the present is then that of the newest.
    const clockMs = this.isLive ? Date.now() : 1000 * (model?.newest("contacts")?.time ?? NaN);
    root.querySelector(".panels").hidden = !model;
    root.querySelector(".empty").hidden = Boolean(model) || !this.isLive || !this.app.hasBroker;
    root.querySelector(".reading").hidden = Boolean(model) || this.isLive || Boolean(this.source.failure);
    root.querySelector(".situation").hidden = !model;
    if (!model) return;
    const isPlaying = this.isLive || this.recording.position.playing;
    const isCut = !this.app.isOpen || (this.isLive && !this.app.hasBroker); // whatever happens now, the page does not receive it
    const hasData = model.arrived > -Infinity && !model.isOffline;
    const isStale = hasData && (isCut || (isPlaying && model.isStale(nowMs)));
    root.classList.toggle("stale", isStale || model.isOffline);
    root.classList.toggle("cut", isCut);
    const past = isStale ? "values" : model.isOffline && model.isSkin && model.newest("decoded") ? "map" : "";
    setText(root.querySelector(".stale-note"), past && `Last ${past}, ${duration((nowMs - model.arrived) / 1000)} old`);
    if (model.isSkin) this.surface.describe(model);
    else this.plate.describe(model);
    this.contacts.describe(model, isStale);
    this.health.describe(model, this.app, clockMs);
    this.commands?.describe(this.selected, this.app.hello.commands, model);
    root.classList.toggle("pressable", this.#pressable());
    root.classList.toggle("emulated", model.truths.length > 0);
    this.presser.describe();
  }

  #describeTabs() {
    const names = this.app.plates(this.source.source);
    if (!names.includes(this.selected)) this.selected = this.model = null; // its topics were cleared
    if (!this.selected && names.length) this.select(this.app.preferred(names));
    const key = names.join("/");
    if (this.tabKey !== key) {
      this.tabKey = key;
      this.tabs.replaceChildren(
        ...names.map((name) => {
          const button = make("button");
          button.type = "button";
          button.append(make("i"), make("span", "", name));
          button.addEventListener("click", () => {
            this.select(name);
            history.replaceState(null, "", `#${encodeURIComponent(name)}`);
          });
          return button;
        }),
      );
    }
    names.forEach((name, index) => {
      const button = this.tabs.children[index];
      const found = situation(this.app.model(this.source.source, name), this.app);
      button.dataset.kind = found.kind;
      if (button.title !== found.title) button.title = found.title;
      button.setAttribute("aria-pressed", name === this.selected);
    });
  }
}
