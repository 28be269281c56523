// Health of the daemon: situation, three states with their reasons, rates, losses, latency, clock, calibration.

import { situation } from "./situation.js";
import { UNKNOWN, bytes, duration, fixed, make, plusMinus, quantity, setRows, setText, sinceTime, words } from "./text.js";

const KINDS = { online: "good", starting: "note", offline: "off", waiting: "warn", stalled: "bad", lost: "bad", drifting: "warn", pressed_at_start: "warn", uncalibrated: "warn", refused: "bad" };
const SIGNS = { good: "✓", note: "…", off: "■", warn: "!", bad: "✕" };
const EXPLAINED = {
  link_gap: "never arrived from the board",
  damaged: "arrived damaged",
  board_overflow: "discarded by the board",
  host_overrun: "lost by the serial port's driver",
  queue_overflow: "discarded before measuring",
  publish_dropped: "messages not written to the broker",
  skipped_late: "messages omitted because they were late",
};

/** Upper bound in ms of the bin in which a share of the messages lies, of those between two messages of health. */
export function quantile(latency, before, share) {
  const counts = latency.counts.map((count, index) => count - (before?.counts[index] ?? 0));
  const total = counts.reduce((sum, count) => sum + count, 0);
  if (!(total > 0)) return NaN;
  let sum = 0;
  const bin = counts.findIndex((count) => (sum += count) >= share * total);
  return latency.bounds[bin] ?? Infinity;
}

const clock = (ppm, uncertainty) => {
  const drift = Number.isFinite(ppm) ? `${fixed(Math.abs(ppm), 1)} ppm ${ppm < 0 ? "slow" : "fast"}` : "drift not known";
  return Number.isFinite(uncertainty) ? `${drift}, times ± ${fixed(1e6 * uncertainty, 0)} µs` : drift;
};
const bound = (ms) => (ms === Infinity ? "longer than all bins" : Number.isNaN(ms) ? UNKNOWN : `≤ ${fixed(ms, ms < 10 ? 1 : 0)} ms`);

export class HealthPanel {
  constructor(root, banner) {
    this.root = root;
    this.banner = banner;
    this.details = root.querySelector("details");
    this.details.addEventListener("toggle", () => root.scrollIntoView({ block: "nearest" }));
    this.rates = new Map();
  }

  describe(model, app, nowMs) {
    const found = situation(model, app);
    const { banner } = this;
    if (banner.dataset.situation !== found.code) {
      banner.dataset.situation = found.code;
      banner.dataset.kind = found.kind;
      banner.querySelector("use").setAttribute("href", `#icon-${found.icon}`);
    }
    setText(banner.querySelector("strong"), found.title);
    const since = Number.isFinite(found.since) ? `${sinceTime(found.since)}. ` : "";
    setText(banner.querySelector(".detail"), since + found.detail);
    this.#describeStates(model, nowMs / 1000, found);
    if (this.details.open) setRows(this.root.querySelector(".figures"), this.#figures(model, app.page, nowMs));
    const { frameRate } = model.health ?? {};
    const frames = Number.isFinite(frameRate) ? `${fixed(frameRate, 0)} of ${quantity(model.info?.frameRate, 0, "frames/s")}` : "frames not known";
    setText(this.root.querySelector(".summary"), `${frames} · ${this.#describeLosses(model)}`);
  }

  #describeStates(model, now, found) {
    const isCut = ["no_server", "no_broker"].includes(found.code);
    const list = this.root.querySelector(".states");
    let isWrong = false;
    ["daemon", "link", "sensor"].forEach((part, index) => {
      const item = list.children[index];
      const state = model.states[part];
      const isPast = isCut || (part !== "daemon" && model.isOffline); // the last one that was published
      const kind = state && !isPast ? (KINDS[state.state] ?? "warn") : "off";
      item.dataset.kind = kind;
      isWrong ||= kind !== "good" && (state || model.source === "live");
      setText(item.querySelector(".sign"), SIGNS[kind]);
      setText(item.querySelector("b"), `${part} ${state ? words(state.state) : "unknown"}`);
      const since = state && !isPast && Number.isFinite(state.since) && now >= state.since ? `for ${duration(now - state.since)}` : "";
      const reason = state?.reason || words(state?.reasonCode ?? "");
      const text = isPast ? "as last published" : `${found.title} ${found.detail}`.includes(reason) ? "" : reason; // the headline has it
      setText(item.querySelector("span:last-child"), state ? [text, since].filter(Boolean).join(", ") : model.source === "live" ? "nothing was published" : "not recorded");
    });
    this.root.classList.toggle("wrong", isWrong);
  }

  /** Messages of a stream that the plate makes a second, from the steps of `seq`. */
  #rate(model, path, nowMs) {
    const seq = model.newest(path)?.seq;
    let rate = this.rates.get(path);
    if (!rate || rate.model !== model || seq < rate.seq) this.rates.set(path, (rate = { model, seq, at: nowMs, value: NaN }));
    else if (nowMs - rate.at >= 1000) {
      rate.value = ((seq - rate.seq) * 1000) / (nowMs - rate.at);
      Object.assign(rate, { seq, at: nowMs });
    }
    return rate.value;
  }

  #figures(model, page, nowMs) {
    const { health, info, previousHealth: before } = model;
    const main = model.isSkin && !model.isOffline && model.newest("decoded") ? "decoded" : "forces";
    const rows = [];
    const rate = this.#rate(model, main, nowMs);
    rows.push(["Frames of the board", Number.isFinite(health?.frameRate) ? `${fixed(health.frameRate, 0)} of ${quantity(info?.frameRate, 0, "/s")}` : UNKNOWN]);
    rows.push([main === "decoded" ? "Decoded maps" : "Messages of forces", quantity(rate, 0, "/s")]);
    for (const [path, latency] of Object.entries(health?.latency ?? {})) {
      const [half, most] = [0.5, 0.99].map((share) => bound(quantile(latency, before?.latency[path], share)));
      rows.push([`Latency of ${path}`, `${half} for half, ${most} for 99 %`]);
    }
    const message = model.newest(main) ?? model.newest("contacts");
    if (message && model.source === "live") rows.push(["Age when shown", `${fixed(1e3 * Math.max(0, nowMs / 1000 - message.time), 0)} ms (both clocks)`]);
    rows.push(["Clock of the board", clock(health?.clockDrift, message?.timeUncertainty)]);
    const { compensation } = model.states.sensor ?? {};
    if (compensation) {
      rows.push(["Baseline", words(compensation.baseline) || UNKNOWN]);
      const { kelvin, kelvinStd } = compensation;
      rows.push(["Temperature", Number.isFinite(kelvin) ? `${plusMinus(kelvin, kelvinStd, "K")} above reference` : "not measured by this counter"]);
    }
    rows.push(this.#calibration(info));
    if (health) {
      const decoder = health.decoder ? `, decoder ${quantity(health.decoder.cpu, 0, "%")}` : "";
      rows.push(["Processor", `${quantity(health.cpu, 0, "% of a core")}${decoder}; ${quantity(health.memory, 0, "MB")}`]);
      rows.push(["Recording", health.recording.failure || (health.recording.file ? `${health.recording.file}, ${bytes(health.recording.bytes)}` : "no"), health.recording.failure ? "bad" : ""]);
    }
    if (info) {
      rows.push(["Plate", [info.plate, `${info.sites.length} ${info.skin ? "sites under a skin" : "force sites"}`, info.counter, info.product].filter(Boolean).join(" · ")]);
      rows.push(["Link", info.link]);
    }
    rows.push(["This page", `${page.clients} open, ${page.skipped} frames skipped as newer ones came${model.unreadable ? `, ${model.unreadable} unreadable` : ""}`]);
    return rows;
  }

  #calibration(info) {
    const { date, expiry } = info?.calibration ?? {};
    const days = (text) => Math.floor((Date.now() - Date.parse(text)) / 86400e3);
    if (!date || !Number.isFinite(days(date))) return ["Calibration", info ? "not calibrated" : UNKNOWN];
    const isOver = days(expiry) > 0;
    return ["Calibration", `${days(date)} days old, ${isOver ? "expired" : "valid"}${expiry ? ` until ${expiry}` : ""}`, isOver ? "bad" : ""];
  }

  #describeLosses(model) {
    const lost = (model.newest("forces") ?? model.newest("contacts") ?? model.health)?.lost;
    const none = lost ? "nothing was lost" : "losses not known";
    const causes = Object.entries(lost ?? {}).filter(([, count]) => count > 0);
    const most = Math.max(1, ...causes.map(([, count]) => count));
    const list = this.root.querySelector(".losses");
    while (list.children.length > Math.max(1, causes.length)) list.lastChild.remove();
    if (!causes.length) causes.push(["", 0]);
    causes.forEach(([cause, count], index) => {
      const item = list.children[index] ?? list.appendChild(make("li"));
      if (!item.firstChild) item.append(make("b"), " ", make("span"), make("i"));
      setText(item.children[0], cause ? `${count}` : "");
      setText(item.children[1], cause ? (EXPLAINED[cause] ?? words(cause)) : none);
      item.children[2].style.width = cause ? `${100 * (Math.log1p(count) / Math.log1p(most))}%` : "0";
    });
    return causes[0][0] ? causes.map(([cause, count]) => `${count} ${EXPLAINED[cause] ?? words(cause)}`).join(", ") : none;
  }
}
