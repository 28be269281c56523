// How a site is identified: for each corner the ladder of codes, and on it the tone that the corner captured.

import { fixed, make, plusMinus, setText, words } from "./text.js";

const SVG = "http://www.w3.org/2000/svg";
const ROW = 66; // height of a corner: its ladder, and below it the band of its site, magnified
const LADDER_Y = 34;
const ZOOM_Y = 58;
const SIDE = 14; // next to the outermost codes
const ZOOM_FROM = 0.16; // of the width: the magnified band
const ZOOM_TO = 0.84;
const LABEL_PX = 13; // of a site's number, at least
const NARROW_PX = 540; // below, a tone is a line of the list, not next to its corner

function shape(parent, tag, attributes, text = "") {
  const element = parent.appendChild(document.createElementNS(SVG, tag));
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text) element.textContent = text;
  return element;
}

export class Ladder {
  /** root has an svg, and a list for the same as text. */
  constructor(root) {
    this.svg = root.querySelector("svg");
    this.list = root.querySelector(".corner-list");
    this.rows = [];
    this.info = null;
    new ResizeObserver(() => this.#draw()).observe(this.svg);
  }

  setInfo(info) {
    this.info = info?.codes.length ? info : null;
    this.width = 0;
    this.#draw();
  }

  /** Draw the codes, which stay the same. */
  #draw() {
    const width = this.svg.clientWidth;
    if (width === this.width || (!width && this.info)) return;
    this.width = width;
    this.svg.replaceChildren();
    this.rows = [];
    if (!this.info) return;
    const { codes, pilot } = this.info;
    const corners = codes[0].f0.length;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${ROW * corners}`);
    this.svg.classList.toggle("narrow", width < NARROW_PX);
    this.svg.style.height = `${ROW * corners}px`;
    for (let corner = 0; corner < corners; corner++) this.rows.push(this.#drawRow(corner, codes, pilot));
  }

  #drawRow(corner, codes, pilot) {
    const { width } = this;
    const row = shape(this.svg, "g", { transform: `translate(0 ${ROW * corner})` });
    const ends = codes.flatMap(({ f0, full }) => [f0[corner], full[corner]]).concat(pilot).filter(Number.isFinite);
    const [low, high] = [Math.min(...ends), Math.max(...ends)];
    const scale = (width - 2 * SIDE) / (high - low || 1);
    const x = (hertz) => SIDE + scale * (hertz - low);
    shape(row, "text", { class: "name", x: 0, y: 11 }, `Corner ${corner + 1}`);
    const said = shape(row, "text", { class: "said", x: 66, y: 11 });
    shape(row, "text", { x: 0, y: LADDER_Y + 18 }, `${fixed(low / 1e6, 3)} MHz`);
    shape(row, "text", { class: "range", x: width, y: LADDER_Y + 18 }, `${fixed(high / 1e6, 3)} MHz`);
    shape(row, "line", { class: "axis", x1: 0, x2: width, y1: LADDER_Y, y2: LADDER_Y });
    const places = codes.map(({ f0 }) => x(f0[corner])).sort((a, b) => a - b);
    const gap = Math.min(...places.slice(1).map((place, index) => place - places[index]));
    const rungs = new Map();
    for (const { site, f0, full } of codes) {
      const [from, to] = [x(f0[corner]), x(full[corner])].sort((a, b) => a - b);
      const rung = shape(row, "g", { class: "rung", "data-site": site });
      shape(rung, "rect", { class: "band", x: from, y: LADDER_Y - 4, width: Math.max(1, to - from), height: 8 });
      shape(rung, "line", { x1: x(f0[corner]), x2: x(f0[corner]), y1: LADDER_Y - 7, y2: LADDER_Y + 7 });
      const label = shape(rung, "text", { x: x(f0[corner]), y: LADDER_Y - 10 }, `${site}`);
      if (gap < LABEL_PX) label.classList.add("crowded");
      rungs.set(site, rung);
    }
    if (Number.isFinite(pilot)) {
      const rung = shape(row, "g", { class: "rung", "data-site": "pilot" });
      shape(rung, "line", { x1: x(pilot), x2: x(pilot), y1: LADDER_Y - 7, y2: LADDER_Y + 7 });
      shape(rung, "text", { x: x(pilot), y: LADDER_Y - 10, class: "end" }, "pilot");
      rungs.set("pilot", rung);
    }
    const zoom = shape(row, "g", { class: "zoom" });
    shape(zoom, "path", { class: "lens" });
    const [from, to] = [ZOOM_FROM * width, ZOOM_TO * width];
    shape(zoom, "rect", { class: "band", x: from, y: ZOOM_Y - 4, width: to - from, height: 8 });
    shape(zoom, "text", { class: "unloaded", y: ZOOM_Y + 4 });
    shape(zoom, "text", { class: "loaded", y: ZOOM_Y + 4 });
    const marks = [shape(row, "g", { class: "mark" }), shape(zoom, "g", { class: "mark" })];
    for (const mark of marks) {
      shape(mark, "line", { class: "noise", y1: 0, y2: 0 });
      shape(mark, "path", { d: "M0 -6L5 0L0 6L-5 0Z" });
    }
    return { x, scale, rungs, zoom, marks, said };
  }

  /** Show the tones of a message, null if there is none. */
  describe(tones) {
    const corners = this.info ? (tones?.corners ?? []) : [];
    while (this.list.children.length > corners.length) this.list.lastChild.remove();
    const reasons = new Set(); // each once
    corners.forEach((tone, corner) => {
      const item = this.list.children[corner] ?? this.list.appendChild(make("li"));
      const reasonCode = reasons.has(tone.reasonCode) ? "" : tone.reasonCode;
      reasons.add(tone.reasonCode);
      const sentence = this.#sentence({ ...tone, reasonCode }, corner);
      setText(item, `Corner ${corner + 1}: ${sentence}`);
      if (this.rows[corner]) setText(this.rows[corner].said, sentence);
    });
    this.rows.forEach((row, corner) => this.#mark(row, corners[corner], corner));
    const summary = corners.map(({ captured, site }, corner) => `corner ${corner + 1} ${captured === "site" ? `site ${site}` : captured}`);
    const label = `Ladders of codes with the captured tones: ${summary.join(", ") || "none yet"}; the list below has the frequencies`;
    if (this.svg.getAttribute("aria-label") !== label) this.svg.setAttribute("aria-label", label);
  }

  #code(site) {
    return this.info.codes.find((code) => code.site === site);
  }

  #mark({ x, scale, rungs, zoom, marks }, tone, corner) {
    const identified = tone?.captured === "site" ? tone.site : tone?.captured;
    for (const [site, rung] of rungs) rung.classList.toggle("identified", site === identified);
    const isKnown = Number.isFinite(tone?.frequency);
    const code = isKnown && tone.captured === "site" ? this.#code(tone.site) : undefined;
    marks[0].style.display = isKnown ? "" : "none";
    zoom.style.display = code ? "" : "none";
    marks[0].classList.toggle("unidentified", tone?.captured === "unidentified");
    if (isKnown) place(marks[0], Math.max(0, Math.min(this.width, x(tone.frequency))), LADDER_Y, scale * tone.noise);
    if (!code) return;
    const [f0, full] = [code.f0[corner], code.full[corner]];
    const [low, high] = [Math.min(f0, full), Math.max(f0, full)];
    const [from, to] = [ZOOM_FROM * this.width, ZOOM_TO * this.width];
    const pixels = (to - from) / (high - low || 1);
    const at = Math.max(from - 20, Math.min(to + 20, from + pixels * (tone.frequency - low)));
    place(marks[1], at, ZOOM_Y, pixels * tone.noise);
    const y = LADDER_Y + 4;
    zoom.querySelector(".lens").setAttribute("d", `M${x(low)} ${y}L${from} ${ZOOM_Y - 4}H${to}L${x(high)} ${y}Z`);
    for (const [name, isLow] of [["unloaded", f0 === low], ["loaded", f0 !== low]]) {
      const label = zoom.querySelector(`.${name}`);
      label.setAttribute("x", isLow ? from - 8 : to + 8);
      label.setAttribute("text-anchor", isLow ? "end" : "start");
      setText(label, `${name === "unloaded" ? 0 : fixed(this.info.forceMax, 0)} N`);
    }
  }

  #sentence({ captured, site, frequency, noise, residual, reasonCode }, corner) {
    if (captured === "none") return `no tone${reasonCode ? `, ${words(reasonCode)}` : ""}.`;
    const hertz = Number.isFinite(frequency) ? plusMinus(frequency, noise, "Hz", 1) : `frequency not known${reasonCode ? `, ${words(reasonCode)}` : ""}`;
    if (captured === "pilot") return `${hertz}, the pilot: not touched.`;
    if (captured !== "site") return `${hertz}, of no site alone.`;
    const f0 = this.#code(site)?.f0[corner];
    const shift = Number.isFinite(f0) ? `, ${fixed(1e6 * (frequency / f0 - 1), 1)} ppm from the code of site ${site}` : `, site ${site}`;
    const off = Number.isFinite(residual) ? `; off the fitted force by ${fixed(residual, 1)} σ` : "";
    return `${hertz}${shift}${off}.`;
  }
}

/** Move a mark; its line has the length of the noise in pixels, to both sides. */
function place(mark, x, y, noise) {
  mark.setAttribute("transform", `translate(${x.toFixed(2)} ${y})`);
  const line = mark.firstChild;
  line.setAttribute("x1", -(noise || 0));
  line.setAttribute("x2", noise || 0);
}
