// The plate as drawn: outline, transducers, sites; touched sites with their force, contacts with their position.

import { MAPS, css, theme } from "./colours.js";
import { Ladder } from "./ladder.js";
import { Scene } from "./scene.js";
import { UNKNOWN, absence, fixed, make, plusMinus, setText, words } from "./text.js";

const NUMBERED_SITES = 64;
const SHEAR_PX = 60; // of the largest force of the plate

export class PlatePanel {
  constructor(root) {
    this.root = root;
    this.scene = new Scene(root.querySelector("canvas"), (context, scene) => this.#drawStill(context, scene));
    this.touched = root.querySelector(".touched");
    this.identification = root.querySelector(".identification");
    this.ladder = new Ladder(this.identification);
    this.caption = root.querySelector(".caption");
    this.byNumber = new Map();
    this.info = null;
  }

  setInfo(info) {
    this.info = info;
    this.byNumber = new Map(info?.sites.map(({ site, position }) => [site, position]));
    if (info) this.scene.show([...info.outline, ...info.transducers, ...info.sites.map(({ position }) => position)]);
    else this.scene.invalidate();
    const size = info?.sites.length ?? 0;
    const parts = info ? [info.plate, `${size} ${info.skin ? "sites under a skin" : "force sites"}`, info.counter, info.product] : [];
    setText(this.caption, info ? parts.filter(Boolean).join(" · ") : "No description of this plate was published yet.");
    this.identification.hidden = !info || info.skin !== null; // sites under a skin are not identified by codes
    this.ladder.setInfo(info);
  }

  #drawStill(context, scene) {
    const { info } = this;
    if (!info) return;
    if (info.outline.length) {
      scene.polygon(context, info.outline);
      context.fillStyle = theme.plate;
      context.fill();
      context.strokeStyle = theme.ink;
      context.lineWidth = 1.5;
      context.stroke();
    }
    const radius = Math.max(0.6, Math.min(9, 0.9 * Math.sqrt((scene.width * scene.height) / Math.max(1, info.sites.length)) / 6));
    this.radius = radius;
    context.fillStyle = theme.site;
    for (const { position } of info.sites) {
      const [x, y] = [scene.x(position[0]), scene.y(position[1])];
      if (radius < 1.5) context.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
      else context.beginPath(), context.arc(x, y, radius, 0, 7), context.fill();
    }
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillStyle = theme.ink;
    if (info.sites.length <= NUMBERED_SITES) {
      for (const { site, position } of info.sites) context.fillText(`${site}`, scene.x(position[0]), scene.y(position[1]));
    }
    context.strokeStyle = theme.accent;
    info.transducers.forEach(([x, y], index) => {
      context.fillStyle = theme.panel;
      context.beginPath();
      context.rect(scene.x(x) - 8, scene.y(y) - 8, 16, 16);
      context.fill();
      context.stroke();
      context.fillStyle = theme.accent;
      context.fillText(`${index + 1}`, scene.x(x), scene.y(y));
    });
  }

  draw(model, presses) {
    const context = this.scene.begin();
    if (!context || !this.info) return;
    const forces = model.newest("forces");
    const contacts = model.newest("contacts");
    if (!this.info.skin) for (const force of forces?.sites ?? []) this.#drawSite(context, force);
    for (const contact of contacts?.contacts ?? []) this.#drawContact(context, contact);
    if (!this.info.skin) for (const force of forces?.sites ?? []) this.#labelSite(context, force);
    drawTruth(context, this.scene, model.truthAt(contacts?.time ?? Infinity), this.info.skin ? null : (force) => this.#siteRadius(force) + 14);
    drawPresses(context, this.scene, presses);
  }

  #siteRadius(force) {
    const most = this.info.forceMax || 10;
    return this.radius + (Math.min(46, this.scene.width / 9) - this.radius) * Math.sqrt(Math.max(0, Math.min(1, force / most)));
  }

  #drawSite(context, { site, force, std, status }) {
    const position = this.byNumber.get(site);
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
    const position = this.byNumber.get(site);
    if (!position) return;
    const y = this.scene.y(position[1]);
    const offset = this.#siteRadius(Number.isFinite(force) ? force : 0) + 14;
    const text = Number.isFinite(atLeast) ? `> ${fixed(atLeast, 1)} N` : Number.isFinite(force) ? plusMinus(force, std, "N") : words(status);
    this.scene.label(context, text, this.scene.x(position[0]), y + (y > this.scene.height / 2 ? -offset : offset));
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
    if (this.info.skin && Number.isFinite(force[2])) {
      scene.label(context, plusMinus(force[2], contact.noise[2], "N"), x, y + (y > scene.height / 2 ? -20 : 20));
    }
  }

  /** Text next to the drawing, a few times a second. */
  describe(model) {
    const { info } = this;
    const rows = [];
    if (!info?.skin) {
      for (const { site, force, std, bound, atLeast, status } of model.newest("forces")?.sites ?? []) {
        const value = Number.isFinite(atLeast) ? `more than ${fixed(atLeast, 1)} N` : plusMinus(force, std, "N");
        const extra = bound > 0 ? `; beside the site at most ${fixed(bound, 2)} N would not be detected` : "";
        rows.push([`Site ${site}`, `${value}${extra}`, status === "ok" ? "" : words(status)]);
      }
    } else {
      for (const { id, site, force, noise, status } of model.newest("contacts")?.contacts ?? []) {
        rows.push([`Contact ${id ?? UNKNOWN}`, `${plusMinus(force[2], noise[2], "N")} near site ${site}`, status === "ok" ? "" : words(status)]);
      }
    }
    while (this.touched.children.length > Math.max(1, rows.length)) this.touched.lastChild.remove();
    if (!rows.length) rows.push([absence(model.newest("contacts")), "", ""]);
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
    const corners = shifts.map((shift, index) => `corner ${index + 1}: ${fixed(1e6 * shift, 2)} ppm`).join(", ");
    setText(this.identification.querySelector(".result"), forces?.reason || identified(forces, model.newest("contacts")));
    const tones = model.newest("tones");
    this.ladder.describe(tones);
    this.identification.classList.toggle("without-tones", !tones || !this.info.codes.length);
    setText(this.identification.querySelector(".corners"), corners ? `Common shift of the tones, taken out: ${corners}.` : "");
  }
}

function identified(forces, contacts) {
  const sites = [...new Set([...(forces?.sites ?? []), ...(contacts?.contacts ?? [])].map(({ site }) => site))];
  if (!sites.length) return "No site is identified: no corner detects a tone of a pressed site.";
  const names = sites.length === 1 ? `site ${sites[0]}` : `sites ${sites.join(", ")}`;
  return forces?.status === "ok" ? `The tones at the corners agree on ${names}.` : `Tones of ${names} are detected: ${words(forces?.status ?? "")}.`;
}

/** Touches as an emulator applies them: hollow diamonds, with a label at `offset(force)` pixels unless it is null. */
export function drawTruth(context, scene, truth, offset) {
  for (const { position, force } of truth?.contacts ?? []) {
    if (!position.every(Number.isFinite)) continue;
    const [x, y] = [scene.x(position[0]), scene.y(position[1])];
    context.strokeStyle = theme.truth;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(x - 8, y);
    context.lineTo(x, y - 8);
    context.lineTo(x + 8, y);
    context.lineTo(x, y + 8);
    context.closePath();
    context.stroke();
    if (offset && Number.isFinite(force[2])) {
      const away = offset(force[2]);
      scene.label(context, `true ${fixed(force[2], 2)} N`, x, y + (y > scene.height / 2 ? away : -away), theme.truth);
    }
  }
}

/** Where the page's user presses: a cross, and the distance that the pointer drags. */
export function drawPresses(context, scene, presses) {
  for (const { position, pointer, isHeld } of presses) {
    const [x, y] = [scene.x(position[0]), scene.y(position[1])];
    context.strokeStyle = theme.truth;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x - 14, y);
    context.lineTo(x + 14, y);
    context.moveTo(x, y - 14);
    context.lineTo(x, y + 14);
    if (isHeld && pointer) {
      context.moveTo(x, y);
      context.lineTo(scene.x(pointer[0]), scene.y(pointer[1]));
    }
    context.stroke();
  }
}
