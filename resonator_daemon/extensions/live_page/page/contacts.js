// Contacts as numbers: force, position, moments, slip margin, next to the ground truth; events; force over a minute.

import { UNKNOWN, absence, clockTime, fixed, make, metres, normalForce, plusMinus, quantity, setRows, setText, words } from "./text.js";
import { onTheme, theme } from "./colours.js";

const CARDS = 6;
const INCIPIENT = 0.3; // of the slip margin: the daemon then publishes incipient_slip
const EVENT_NAMES = {
  onset: "touched",
  release: "released",
  incipient_slip: "begins to slip",
  gross_slip: "slips",
};

/** The slip margin in words: {text, word, kind}; null where the plate has none. */
export function slipState({ hasSlip, slipMargin, slipMarginStd, slipReason }) {
  if (!hasSlip) return null;
  const unknown = `not known${slipReason ? `: ${words(slipReason)}` : ""}`;
  if (!Number.isFinite(slipMargin)) return { text: unknown, word: unknown, kind: "off" };
  const word = slipMargin <= 0 ? "slips" : slipMargin < INCIPIENT ? "begins to slip" : "sticks";
  return { text: `${plusMinus(slipMargin, slipMarginStd, "")}, ${word}`, word, kind: slipMargin < INCIPIENT ? "bad" : "good" };
}

export class ContactsPanel {
  constructor(root) {
    this.root = root;
    this.cards = root.querySelector(".cards");
    this.more = root.querySelector(".more");
    this.template = root.querySelector("template");
    this.events = root.querySelector(".events");
    this.chartRoot = root.querySelector(".chart");
    this.eventVersion = -1;
    this.history = null;
    this.historyVersion = -1;
    onTheme(() => this.#makeChart());
    new ResizeObserver(() => this.chart?.setSize(this.#size())).observe(this.chartRoot);
  }

  describe(model, isStale) {
    const message = model.newest("contacts");
    const contacts = message?.contacts ?? [];
    const truths = [...(model.truthAt(message?.time ?? Infinity)?.contacts ?? [])];
    while (this.cards.children.length > Math.min(CARDS, contacts.length)) this.cards.lastChild.remove();
    contacts.slice(0, CARDS).forEach((contact, index) => {
      const card = this.cards.children[index] ?? this.cards.appendChild(this.template.content.firstElementChild.cloneNode(true));
      this.#fill(card, contact, takeNearest(truths, contact.position));
    });
    setText(this.more, contacts.length > CARDS ? `and ${contacts.length - CARDS} more` : contacts.length ? "" : absence(model));
    this.#describeEvents(model);
    this.#drawChart(model, isStale || model.isOffline);
  }

  #fill(card, contact, truth) {
    const { force, noise, position, covariance, moment, momentStd } = contact;
    const hasShear = Number.isFinite(force[0]) && Number.isFinite(force[1]);
    setText(card.querySelector("h4"), `Contact ${contact.id ?? UNKNOWN}, site ${contact.site ?? UNKNOWN}`);
    setText(card.querySelector(".status"), contact.status === "ok" ? "" : words(contact.status) + (contact.reasonCode ? `: ${words(contact.reasonCode)}` : ""));
    setText(card.querySelector(".normal"), normalForce(contact));
    const difference = truth ? force[2] - truth.force[2] : NaN;
    setText(card.querySelector(".true"), truth ? `true ${quantity(truth.force[2], 3, "N")}${Number.isFinite(difference) ? `, off by ${quantity(1e3 * difference, 0, "mN")}` : ""}` : "");
    drawVector(card.querySelector("svg"), force, truth);
    const rows = [];
    if (hasShear) {
      rows.push(["Force x, y", `${fixed(force[0], 3)}, ${plusMinus(force[1], Math.max(noise[0], noise[1]), "N")}`]);
      if (truth) rows.push(["true x, y", `${fixed(truth.force[0], 3)}, ${fixed(truth.force[1], 3)} N`, "truth"]);
    }
    rows.push(["Position", `${fixed(1e3 * position[0], 2)}, ${fixed(1e3 * position[1], 2)} mm ± ${metres(Math.sqrt(Math.max(covariance[0], covariance[2])))}`]);
    if (truth) rows.push(["true position", `${fixed(1e3 * truth.position[0], 2)}, ${fixed(1e3 * truth.position[1], 2)} mm`, "truth"]);
    if (moment) {
      rows.push(["Moment", `${moment.map((value) => fixed(1e3 * value, 3)).join(", ")} mN m`]);
      rows.push(["± moment", `${momentStd.map((value) => fixed(1e3 * value, 3)).join(", ")} mN m`]);
    }
    if (contact.hasSlip) {
      rows.push(["Friction", plusMinus(contact.friction, contact.frictionStd, "")]);
      rows.push(["χ² of the fit", fixed(contact.chi2, 2)]);
      rows.push(["Object", contact.shape || UNKNOWN]);
    }
    setRows(card.querySelector("dl"), rows);
    this.#fillGauge(card.querySelector(".gauge"), contact);
  }

  #fillGauge(gauge, contact) {
    const slip = slipState(contact);
    gauge.hidden = !slip;
    if (!slip) return;
    const isKnown = Number.isFinite(contact.slipMargin);
    const bar = gauge.querySelector(".bar");
    const shown = Math.max(0, Math.min(1, isKnown ? contact.slipMargin : 0));
    bar.firstElementChild.style.width = `${100 * shown}%`;
    gauge.style.setProperty("--tick", `${100 * INCIPIENT}%`);
    gauge.dataset.kind = slip.kind;
    setText(gauge.querySelector("small"), `${INCIPIENT}: below, it begins to slip`);
    setText(gauge.querySelector("output"), slip.text);
    if (isKnown) bar.setAttribute("aria-valuenow", shown.toFixed(2));
    else bar.removeAttribute("aria-valuenow");
    bar.setAttribute("aria-valuetext", isKnown ? `${fixed(contact.slipMargin, 2)}, ${slip.word}` : slip.word);
  }

  #describeEvents(model) {
    if (this.eventVersion === model.eventVersion && this.model === model) return;
    this.eventVersion = model.eventVersion;
    this.model = model;
    const items = model.events.slice(0, 12).map((event) => {
      const item = make("li");
      const { id, site, peak, duration } = event.contact;
      const end = event.event === "release" ? `, peak ${fixed(peak, 2)} N, ${fixed(duration, 1)} s` : "";
      const reason = event.event === "release" && event.reason ? ` (${event.reason})` : "";
      item.append(make("time", "", clockTime(event.time)), " ", make("b", event.event, `Contact ${id ?? UNKNOWN} ${EVENT_NAMES[event.event] ?? words(event.event)}`));
      item.append(`, site ${site ?? UNKNOWN}${end}${reason}`);
      return item;
    });
    this.events.replaceChildren(...(items.length ? items : [make("li", "", "No events yet.")]));
  }

  #size() {
    return { width: Math.max(120, this.chartRoot.clientWidth), height: Math.max(110, this.chartRoot.clientHeight) };
  }

  #makeChart() {
    this.chart?.destroy();
    const axis = { stroke: theme.muted, grid: { stroke: theme.line, width: 1 }, ticks: { stroke: theme.line, width: 1 }, font: "12px system-ui" };
    const line = (label, stroke, more = {}) => ({ label, stroke, width: 2, points: { show: false }, ...more });
    this.chart = new uPlot(
      {
        ...this.#size(),
        cursor: { drag: { x: false, y: false } },
        legend: { show: false },
        scales: { x: { time: false, range: [-60, 0] }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(0.1, 1.1 * (high ?? 0))] } },
        axes: [
          { ...axis, size: 30, values: (_, ticks) => ticks.map((tick) => (tick ? `${tick} s` : this.isPast ? "last" : "now")) },
          { ...axis, size: 64, space: 34, values: (_, ticks) => ticks.map((tick) => `${tick} N`) },
        ],
        series: [
          {},
          line("", "transparent"),
          line("", "transparent"),
          line("true", theme.truth, { dash: [3, 4] }),
          line("tangential", theme.warn, { dash: [9, 4] }),
          line("normal", theme.accent),
        ],
        bands: [{ series: [1, 2], fill: `color-mix(in srgb, ${theme.accent} 25%, transparent)` }],
      },
      this.#data([]),
      this.chartRoot,
    );
  }

  #data(rows) {
    return [0, 1, 2, 3, 4, 5].map((index) => rows[index] ?? []);
  }

  /** Draw what changed; isPast: the newest value is not the present one. */
  #drawChart(model, isPast) {
    const { history } = model;
    if (!this.chart) this.#makeChart();
    if (history === this.history && history.version === this.historyVersion && isPast === this.isPast) return;
    this.isPast = isPast;
    this.history = history;
    this.historyVersion = history.version;
    const { length } = history;
    const last = history.rows[0][length - 1];
    const [times, normal, std, shear, truth] = history.rows.map((row) => row.subarray(0, length));
    this.columns ??= Array.from({ length: 6 }, () => new Array());
    const [ages, high, low, applied, tangential, force] = this.columns;
    for (const column of this.columns) column.length = length;
    for (let at = 0; at < length; at++) {
      const isKnown = normal[at] === normal[at];
      ages[at] = times[at] - last;
      high[at] = isKnown ? normal[at] + std[at] : null;
      low[at] = isKnown ? normal[at] - std[at] : null;
      applied[at] = truth[at] === truth[at] ? truth[at] : null;
      tangential[at] = shear[at] === shear[at] ? shear[at] : null;
      force[at] = isKnown ? normal[at] : null;
    }
    this.chart.setData(this.columns);
    setText(this.root.querySelector(".chart-summary"), length ? `normal force ${isPast ? "last" : "now"} ${fixed(normal[length - 1], 2)} N` : "");
  }
}

/** Remove and return the true touch nearest to a position; null where there is none. */
function takeNearest(truths, position) {
  let best = -1;
  let least = Infinity;
  truths.forEach((truth, index) => {
    const away = Math.hypot(truth.position[0] - position[0], truth.position[1] - position[1]);
    if (away < least) (least = away), (best = index);
  });
  return best < 0 ? null : truths.splice(best, 1)[0];
}

/** The force vector seen from the touched side (arrow) and from the side (bar), as lines of an SVG. */
function drawVector(svg, force, truth) {
  const scale = 20 / Math.max(0.2, Math.hypot(force[0] || 0, force[1] || 0), Math.hypot(truth?.force[0] || 0, truth?.force[1] || 0));
  for (const [name, vector] of [["estimate", force], ["applied", truth?.force ?? [NaN, NaN]]]) {
    const line = svg.querySelector(`.${name}`);
    const isKnown = Number.isFinite(vector[0]) && Number.isFinite(vector[1]);
    line.setAttribute("x2", isKnown ? 24 + scale * vector[0] : 24);
    line.setAttribute("y2", isKnown ? 24 + scale * vector[1] : 24);
  }
  svg.toggleAttribute("hidden", !Number.isFinite(force[0]));
}
