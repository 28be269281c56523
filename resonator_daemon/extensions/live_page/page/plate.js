// The plate as drawn: outline, transducers, sites; touched sites with their force, contacts with their position.

import { MAPS, css, theme } from "./colours.js";
import { Ladder } from "./ladder.js";
import { circle, drawOutline, drawPresses, drawSuspects, drawTrails, drawTransducers, drawTruth, extent } from "./marks.js";
import { BOLD, Scene } from "./scene.js";
import { absence, fixed, make, plusMinus, setText, words } from "./text.js";

const NUMBERED_SITES = 64;
const SHEAR_PX = 60; // of the largest force of the plate

export class PlatePanel {
  constructor(root, identification) {
    this.scene = new Scene(root.querySelector(".scene"), (context, scene) => this.#drawStill(context, scene));
    this.texts = new Map(); // by site, as the list shows them now: two numbers of one quantity would differ
    this.over = null; // the site under the pointer
    for (const type of ["pointermove", "pointerdown", "pointerleave"]) {
      this.scene.canvas.addEventListener(type, (event) => {
        const over = this.info && type !== "pointerleave" ? siteAt(this.info, this.scene.position(event)) : null;
        if (over !== this.over) (this.over = over), (this.scene.changed = true);
      });
    }
    this.touched = root.querySelector(".touched");
    this.identification = identification;
    this.ladder = new Ladder(this.identification);
    this.caption = root.querySelector(".caption");
    this.info = null;
  }

  setInfo(info) {
    this.info = info;
    this.over = null;
    if (info) this.scene.show(extent(info));
    else this.scene.invalidate();
    setText(this.caption, info ? "" : "No description of this plate was published yet.");
    this.identification.hidden = !info || info.skin !== null; // sites under a skin are not identified by codes
    this.ladder.setInfo(info);
  }

  #drawStill(context, scene) {
    const { info } = this;
    if (!info) return;
    drawOutline(context, scene, info);
    const radius = Math.max(0.6, Math.min(11, 1.1 * Math.sqrt((scene.width * scene.height) / Math.max(1, info.sites.length)) / 6));
    this.radius = radius;
    context.fillStyle = theme.site;
    for (const { position } of info.sites) {
      const [x, y] = [scene.x(position[0]), scene.y(position[1])];
      if (radius < 1.5) context.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
      else context.beginPath(), context.arc(x, y, radius, 0, 7), context.fill();
    }
    context.textAlign = "center";
    context.textBaseline = "middle";
    if (info.sites.length <= NUMBERED_SITES) {
      context.strokeStyle = theme.site;
      context.lineWidth = 1;
      for (const { site, position } of info.sites) {
        const [x, y] = [scene.x(position[0]), scene.y(position[1])];
        circle(context, x, y, scene.scale * info.target); // where a press counts as one of this site
        context.stroke();
        context.fillStyle = theme.ink;
        context.fillText(`${site}`, x, y);
      }
    }
    drawTransducers(context, scene, info);
  }

  draw(model, presses) {
    const context = this.scene.begin();
    if (!context || !this.info) return;
    const forces = model.newest("forces");
    const contacts = model.newest("contacts");
    if (this.over !== null) this.#drawTarget(context, this.info.places.get(this.over));
    drawTrails(context, this.scene, model);
    for (const force of forces?.sites ?? []) this.#drawSite(context, force);
    for (const contact of contacts?.contacts ?? []) this.#drawContact(context, contact);
    for (const force of forces?.sites ?? []) this.#labelSite(context, force);
    drawSuspects(context, this.scene, this.info, model.suspects);
    drawTruth(context, this.scene, model.truthAt(contacts?.time ?? Infinity), (force) => this.#siteRadius(force) + 16);
    drawPresses(context, this.scene, presses);
  }

  #drawTarget(context, [x, y]) {
    circle(context, this.scene.x(x), this.scene.y(y), this.scene.scale * this.info.target);
    context.fillStyle = theme.accent;
    context.globalAlpha = 0.22;
    context.fill();
    context.globalAlpha = 1;
    context.strokeStyle = theme.accent;
    context.lineWidth = 2;
    context.stroke();
  }

  #siteRadius(force) {
    const most = this.info.forceMax || 10;
    return this.radius + (Math.min(60, this.scene.width / 9) - this.radius) * Math.sqrt(Math.max(0, Math.min(1, force / most)));
  }

  #drawSite(context, { site, force, std, status }) {
    const position = this.info.places.get(site);
    if (!position) return;
    const [x, y] = [this.scene.x(position[0]), this.scene.y(position[1])];
    const radius = Number.isFinite(force) ? this.#siteRadius(force) : this.radius + 6;
    context.beginPath();
    context.arc(x, y, radius, 0, 7);
    if (Number.isFinite(force)) {
      context.globalAlpha = 0.8;
      context.fillStyle = css(MAPS.viridis, 0.25 + (0.75 * force) / (this.info.forceMax || 10));
      context.fill();
      context.globalAlpha = 1;
      context.strokeStyle = theme.ink;
      context.lineWidth = 1;
      for (const bound of [force - std, force + std]) {
        if (!(bound > 0)) continue;
        context.beginPath();
        context.arc(x, y, this.#siteRadius(bound), 0, 7);
        context.stroke();
      }
    }
    if (status !== "ok") {
      context.setLineDash([4, 3]);
      context.lineWidth = 2;
      context.strokeStyle = theme.warn;
      context.beginPath();
      context.arc(x, y, radius + 4, 0, 7);
      context.stroke();
      context.setLineDash([]);
    }
  }

  #labelSite(context, { site, force, std, atLeast, status }) {
    const position = this.info.places.get(site);
    if (!position) return;
    const y = this.scene.y(position[1]);
    const offset = this.#siteRadius(Number.isFinite(force) ? force : 0) + 16;
    const text = this.texts.get(site) ?? siteForce({ atLeast, force, std, status });
    this.scene.label(context, text, this.scene.x(position[0]), y + (y > this.scene.height / 2 ? -offset : offset), theme.ink, BOLD);
    context.fillStyle = theme.ink;
    this.scene.label(context, `${site}`, this.scene.x(position[0]), y);
  }

  #drawContact(context, contact) {
    const { scene } = this;
    const { position, covariance, force } = contact;
    if (!position.every(Number.isFinite)) return;
    context.strokeStyle = theme.accent;
    if (Number.isFinite(covariance[0]) && Number.isFinite(covariance[2])) {
      scene.ellipse(context, position, covariance);
      context.stroke();
    }
    const [x, y] = [scene.x(position[0]), scene.y(position[1])];
    context.beginPath();
    context.moveTo(x - 5, y);
    context.lineTo(x + 5, y);
    context.moveTo(x, y - 5);
    context.lineTo(x, y + 5);
    const pixels = (2 * SHEAR_PX) / (this.info.forceMax || 5);
    if (Number.isFinite(force[0]) && Number.isFinite(force[1])) scene.arrow(context, x, y, pixels * force[0], pixels * force[1]);
    context.stroke();
  }

  /** Text next to the drawing, a few times a second. */
  describe(model) {
    const rows = [];
    this.texts.clear();
    for (const { site, force, std, bound, atLeast, status } of model.newest("forces")?.sites ?? []) {
      const value = siteForce({ atLeast, force, std, status });
      const extra = bound > 0 ? `; a touch next to the site of up to ${fixed(bound, 2)} N would not be detected` : "";
      this.texts.set(site, value);
      rows.push([`Site ${site}`, `${value}${extra}`, ["ok", value].includes(words(status)) ? "" : words(status)]);
    }
    while (this.touched.children.length > Math.max(1, rows.length)) this.touched.lastChild.remove();
    if (!rows.length) rows.push([absence(model), "", ""]);
    rows.forEach(([name, value, status], index) => {
      const item = this.touched.children[index] ?? this.touched.appendChild(make("li"));
      if (!item.firstChild) item.append(make("b"), " ", make("span"), " ", make("em", "status"));
      setText(item.querySelector("b"), name);
      setText(item.querySelector("span"), value);
      setText(item.querySelector("em"), status);
    });
    if (!this.identification.hidden) this.#describeIdentification(model);
  }

  #describeIdentification(model) {
    const forces = model.newest("forces");
    const shifts = model.states.sensor?.compensation?.commonMode ?? [];
    const corners = shifts.map((shift) => fixed(1e6 * shift, 2)).join(", ");
    setText(this.identification.querySelector(".result"), forces?.reason || identified(forces, model.newest("contacts")));
    const tones = model.newest("tones");
    this.ladder.describe(tones);
    this.identification.classList.toggle("without-tones", !tones || !this.info.codes.length);
    setText(this.identification.querySelector(".corners"), corners ? `Common shift of the tones, taken out: ${corners} ppm.` : "");
  }
}

function identified(forces, contacts) {
  const sites = [...new Set([...(forces?.sites ?? []), ...(contacts?.contacts ?? [])].map(({ site }) => site))];
  if (!sites.length) return "No site is identified: no corner detects a tone of a pressed site.";
  const names = sites.length === 1 ? `site ${sites[0]}` : `sites ${sites.join(", ")}`;
  return forces?.status === "ok" ? `The tones at the corners agree on ${names}.` : `Tones of ${names} are detected: ${words(forces?.status ?? "")}.`;
}

const siteForce = ({ atLeast, force, std, status }) => {
  if (Number.isFinite(atLeast)) return `more than ${fixed(atLeast, 1)} N`;
  return Number.isFinite(force) ? plusMinus(force, std, "N") : words(status);
};

/** Number of the site that a press at a position counts as one of; null between sites. */
export function siteAt({ sites, target }, [x, y]) {
  return sites.find(({ position }) => Math.hypot(x - position[0], y - position[1]) <= target)?.site ?? null;
}
