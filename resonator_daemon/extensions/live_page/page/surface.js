// What acts on a skin's surface: a map as colour, shear as arrows, the contact's outline and the zone that sticks.

import { MAPS, theme } from "./colours.js";
import { slipState } from "./contacts.js";
import { drawOutline, drawPresses, drawSuspects, drawTrails, drawTransducers, drawTruth, extent, isArea, twice } from "./marks.js";
import { ReliefPanel } from "./relief.js";
import { BOLD, Scene } from "./scene.js";
import { metres, normalForce, pascals, setText } from "./text.js";

const OUTLINE = 0.15; // of the peak: what the daemon counts as a part of the contact
const ARROWS = 18; // along each side of a grid, at most
const LEAST_SHEAR = 0.08; // of the longest arrow
const SIGMAS = 3; // of its noise, which a shear exceeds that is drawn
const OUTSIDE = 1.2; // times a contact's radius: beyond its outline
const STICK_LABEL_PX = 45; // radius with room for it
const RASTER = 128; // pixels along each side where sites are scattered
const REACH = 2; // mean distances of sites: farther from the nearest, the map is not known

const LAYERS = {
  traction: { map: MAPS.viridis, unit: pascals, name: "normal traction", least: 1e3 },
  shear: { map: MAPS.viridis, unit: pascals, name: "shear traction", least: 1e3 },
  std: { map: MAPS.cividis, unit: pascals, name: "standard deviation of the normal traction", least: 100 },
  displacement: { map: MAPS.plasma, unit: metres, name: "indentation", least: 1e-6 },
  error: { map: MAPS.diverging, unit: pascals, name: "estimate minus ground truth, normal traction", least: 1e3, signed: true },
};

const texts = (contact) => [normalForce(contact), slipState(contact)];

function niceAbove(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 5, 7, 10].map((factor) => factor * power).find((step) => step >= value * 0.999);
}

export class SurfacePanel {
  constructor(root) {
    this.root = root;
    this.scene = new Scene(root.querySelector(".scene"), (context, scene) => this.#drawStill(context, scene));
    this.relief = new ReliefPanel(root, () => (this.scene.changed = true));
    this.picture = document.createElement("canvas");
    this.layer = "traction";
    this.top = LAYERS.traction.least;
    this.select = root.querySelector("select");
    this.select.addEventListener("change", () => this.#choose(this.select.value));
    this.arrows = root.querySelector(".arrows");
    this.arrows.addEventListener("change", () => (this.scene.changed = true));
    this.bar = root.querySelector(".scale canvas");
    this.info = null;
    this.values = new Float32Array(0);
    this.texts = new Map(); // by contact, as the list shows them now: two numbers of one quantity would differ
    this.draws = 0;
    this.#drawBar();
  }

  #choose(layer) {
    this.layer = layer;
    this.top = LAYERS[layer].least;
    this.scene.changed = true;
    this.#drawBar();
  }

  setInfo(info) {
    this.info = info;
    this.places = null;
    this.raster = null;
    if (info) this.scene.show(extent(info)), this.relief.setPlate(info, extent(info));
    this.scene.invalidate();
  }

  #drawStill(context, scene) {
    if (this.info) drawOutline(context, scene, this.info);
  }

  #drawBar() {
    const context = this.bar.getContext("2d");
    const { map } = LAYERS[this.layer];
    const picture = context.createImageData(256, 1);
    new Uint32Array(picture.data.buffer).set(map);
    this.bar.width = 256;
    this.bar.height = 1;
    context.putImageData(picture, 0, 0);
  }

  /** Where the map's values lie: a grid of the message, or the sites. */
  #setPlaces(decoded) {
    const { shape } = decoded.traction;
    const key = shape.join();
    const origin = decoded.grid?.origin;
    if (this.places?.key === key && this.places.origin?.[0] === origin?.[0] && this.places.origin?.[1] === origin?.[1]) return;
    const isGrid = shape.length === 3 && decoded.grid;
    const count = shape.slice(1).reduce((product, length) => product * length, 1);
    this.places = { key, origin, count, isGrid };
    this.raster = null;
    if (isGrid) {
      const [, rows, columns] = shape;
      Object.assign(this.places, { rows, columns, pitch: decoded.grid.pitch });
    } else this.#setRaster(count);
    const { rows, columns } = this.places;
    this.picture.width = columns;
    this.picture.height = rows;
    this.image = new ImageData(columns, rows);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.values = new Float32Array(count);
  }

  /** For scattered sites: the nearest site of each pixel, or -1 where none is near. */
  #setRaster(count) {
    const sites = this.info?.sites.slice(0, count) ?? [];
    const [left, top, right, bottom] = this.scene.bounds;
    const pitch = Math.max(right - left, bottom - top) / RASTER;
    const [columns, rows] = [Math.ceil((right - left) / pitch), Math.ceil((bottom - top) / pitch)];
    const nearest = new Int32Array(columns * rows).fill(-1);
    const distance = new Float32Array(columns * rows).fill(Infinity);
    const reach = Math.min(RASTER, Math.ceil(REACH * Math.sqrt((columns * rows) / Math.max(1, sites.length))));
    sites.forEach(({ position: [x, y] }, index) => {
      const [column, row] = [(x - left) / pitch - 0.5, (y - top) / pitch - 0.5];
      const [firstRow, lastRow] = [Math.max(0, Math.ceil(row - reach)), Math.min(rows - 1, Math.floor(row + reach))];
      const [firstColumn, lastColumn] = [Math.max(0, Math.ceil(column - reach)), Math.min(columns - 1, Math.floor(column + reach))];
      for (let j = firstRow; j <= lastRow; j++) {
        for (let i = firstColumn; i <= lastColumn; i++) {
          const away = (i - column) ** 2 + (j - row) ** 2;
          const at = j * columns + i;
          if (away < distance[at] && away <= reach * reach) (distance[at] = away), (nearest[at] = index);
        }
      }
    });
    this.raster = nearest;
    Object.assign(this.places, { rows, columns, pitch, origin: undefined, corner: [left + pitch / 2, top + pitch / 2] });
  }

  /** Fill `values` with the chosen layer; false where this plate does not have it. */
  #fill(decoded, truth) {
    const { count } = this.places;
    const { values } = this;
    const traction = decoded.traction.values;
    const source = { traction, std: decoded.std?.values, displacement: decoded.displacement?.values }[this.layer];
    if (this.layer === "shear") {
      for (let at = 0; at < count; at++) values[at] = Math.hypot(traction[at], traction[count + at]);
    } else if (this.layer === "error") {
      if (!truth) return false;
      this.#fillError(traction, truth);
    } else {
      if (source?.length !== 3 * count) return false;
      for (let at = 0; at < count; at++) values[at] = source[2 * count + at];
    }
    return true;
  }

  /** Estimate minus the Hertz pressure 3 F / (2 π a²) · √(1 − r²/a²) of each applied touch. */
  #fillError(traction, truth) {
    const { count, columns, pitch, isGrid, origin } = this.places;
    const { values } = this;
    for (let at = 0; at < count; at++) values[at] = traction[2 * count + at];
    for (const { position, force, radius } of truth.contacts) {
      if (!(radius > 0) || !(force[2] > 0)) continue;
      const peak = (1.5 * force[2]) / (Math.PI * radius * radius);
      for (let at = 0; at < count; at++) {
        const place = isGrid ? null : this.info.sites[at]?.position;
        const x = isGrid ? origin[0] + pitch * (at % columns) : place?.[0];
        const y = isGrid ? origin[1] + pitch * Math.floor(at / columns) : place?.[1];
        const share = 1 - ((x - position[0]) ** 2 + (y - position[1]) ** 2) / (radius * radius);
        if (share > 0) values[at] -= peak * Math.sqrt(share);
      }
    }
  }

  draw(model, presses) {
    const decoded = model.newest("decoded");
    const truth = model.truthAt(decoded?.time ?? Infinity);
    const contacts = model.newest("contacts")?.contacts ?? [];
    this.hasContact = contacts.length > 0;
    if (this.relief.isShown && this.info) return this.#drawRelief(model, decoded, truth, contacts, presses);
    const context = this.scene.begin();
    if (!context || !this.info) return;
    this.draws += 1;
    if (decoded?.traction) {
      this.#setPlaces(decoded);
      if (this.#fill(decoded, truth)) this.#paint(context);
      if (this.places.isGrid) this.#drawOutline(context, decoded.traction.values);
      if (this.arrows.checked) this.#drawShear(context, decoded.traction.values, decoded.std?.values);
    }
    drawTransducers(context, this.scene, this.info);
    drawTrails(context, this.scene, model);
    for (const { position, radius } of truth?.contacts ?? []) {
      if (!(radius > 0)) continue;
      context.strokeStyle = theme.truth;
      context.setLineDash([2, 4]);
      context.beginPath();
      context.arc(this.scene.x(position[0]), this.scene.y(position[1]), this.scene.scale * radius, 0, 7);
      context.stroke();
      context.setLineDash([]);
    }
    drawTruth(context, this.scene, truth, null);
    drawPresses(context, this.scene, presses);
    drawSuspects(context, this.scene, this.info, model.suspects);
    const patches = model.newest("decoded/summary")?.patches ?? [];
    for (const contact of contacts) this.#drawContact(context, contact, patches.find(({ id }) => id === contact.id));
  }

  /** The displacement as height, coloured as the flat map. */
  #drawRelief(model, decoded, truth, contacts, presses) {
    this.scene.changed = false;
    this.draws += 1;
    const label = (kind, all, text) => all.map((item, index) => ({ kind, text: text(item, index), position: item.position ?? item }));
    const labels = [
      ...label("transducer", this.info.transducers, (_, index) => `${index + 1}`),
      ...label("truth", truth?.contacts ?? [], () => ""),
      ...label("suspect", model.suspects.map((site) => ({ site, position: this.info.places.get(site) })), ({ site }) => `site ${site} suspect`),
      ...label("contact", contacts, (contact) => (this.texts.get(contact.id) ?? texts(contact))[0]),
    ];
    this.relief.draw(this.#reliefMap(decoded, truth), labels.filter(({ position }) => position?.every(Number.isFinite)), presses);
  }

  /** The map that the relief draws; null where displacement or chosen layer are missing. */
  #reliefMap(decoded, truth) {
    if (!decoded?.traction || decoded.displacement?.values.length !== decoded.traction.values.length) return null;
    this.#setPlaces(decoded);
    if (!this.#fill(decoded, truth)) return null;
    this.#colour();
    const { count, rows, columns, pitch, isGrid, origin, corner } = this.places;
    const depths = new Float32Array(rows * columns);
    const normal = decoded.displacement.values.subarray(2 * count);
    for (let at = 0; at < depths.length; at++) depths[at] = normal[this.raster ? this.raster[at] : at] ?? NaN;
    return { rows, columns, pitch, corner: isGrid ? origin : corner, depths, pixels: this.pixels };
  }

  /** Fill `pixels` with the colours of `values`. */
  #colour() {
    const { map, least, signed } = LAYERS[this.layer];
    const { values, pixels, raster } = this;
    let most = 0;
    for (let at = 0; at < values.length; at++) most = Math.max(most, signed ? Math.abs(values[at]) || 0 : values[at] || 0);
    this.peak = most;
    const wanted = niceAbove(Math.max(most, least));
    if (wanted > this.top || wanted < 0.4 * this.top) this.top = wanted;
    const factor = (signed ? 127.5 : 255) / this.top;
    const offset = signed ? 127.5 : 0;
    for (let pixel = 0; pixel < pixels.length; pixel++) {
      const at = raster ? raster[pixel] : pixel;
      const value = at < 0 ? NaN : values[at];
      pixels[pixel] = value === value ? map[Math.max(0, Math.min(255, (offset + factor * value) | 0))] : 0;
    }
  }

  #paint(context) {
    this.#colour();
    const { rows, columns, pitch, isGrid } = this.places;
    this.picture.getContext("2d").putImageData(this.image, 0, 0);
    const [x, y] = isGrid ? this.places.origin : this.places.corner;
    context.imageSmoothingEnabled = false;
    const size = this.scene.scale * pitch;
    context.save();
    if (isArea(this.info.outline)) this.scene.polygon(context, this.info.outline), context.clip();
    context.drawImage(this.picture, this.scene.x(x) - size / 2, this.scene.y(y) - size / 2, size * columns, size * rows);
    context.restore();
  }

  /** The line at 15 % of the peak between neighbouring pixels (marching squares). */
  #drawOutline(context, traction) {
    const { count, rows, columns, pitch, origin } = this.places;
    const normal = traction.subarray(2 * count);
    let most = 0;
    for (let at = 0; at < count; at++) most = Math.max(most, normal[at] || 0);
    if (!(most > 0) || !this.hasContact) return;
    const level = OUTLINE * most;
    const step = this.scene.scale * pitch;
    const [x0, y0] = [this.scene.x(origin[0]), this.scene.y(origin[1])];
    context.beginPath();
    for (let row = 0; row + 1 < rows; row++) {
      for (let column = 0; column + 1 < columns; column++) {
        const at = row * columns + column;
        const a = normal[at] - level;
        const b = normal[at + 1] - level;
        const c = normal[at + columns + 1] - level;
        const d = normal[at + columns] - level;
        if (a > 0 === b > 0 && b > 0 === c > 0 && c > 0 === d > 0) continue;
        const x = x0 + step * column;
        const y = y0 + step * row;
        let isFirst = true;
        const edge = (dx, dy) => {
          if (isFirst) context.moveTo(x + step * dx, y + step * dy);
          else context.lineTo(x + step * dx, y + step * dy);
          isFirst = !isFirst;
        };
        if (a > 0 !== b > 0) edge(a / (a - b), 0);
        if (b > 0 !== c > 0) edge(1, b / (b - c));
        if (c > 0 !== d > 0) edge(d / (d - c), 1);
        if (d > 0 !== a > 0) edge(0, a / (a - d));
      }
    }
    twice(context, 2);
  }

  /** Arrows where the shear exceeds its noise. */
  #drawShear(context, traction, std) {
    const { count, rows, columns, pitch, isGrid, origin } = this.places;
    let most = 0;
    for (let at = 0; at < count; at++) most = Math.max(most, Math.hypot(traction[at], traction[count + at]) || 0);
    this.longest = 0;
    if (!(most > 0) || !this.hasContact) return;
    const stride = isGrid ? Math.max(1, Math.ceil(Math.max(rows, columns) / ARROWS)) : 1;
    const length = (1.6 * stride * this.scene.scale * (isGrid ? pitch : Math.sqrt(this.#area() / count))) / most;
    context.beginPath();
    for (let at = 0; at < count; at++) {
      if (isGrid && ((at % columns) % stride || Math.floor(at / columns) % stride)) continue;
      const [tx, ty] = [traction[at], traction[count + at]];
      const noise = std?.length === traction.length ? SIGMAS * Math.max(std[at], std[count + at]) : 0;
      if (!(Math.hypot(tx, ty) > Math.max(noise, LEAST_SHEAR * most))) continue;
      this.longest = Math.max(this.longest, Math.hypot(tx, ty));
      const place = isGrid ? null : this.info.sites[at]?.position;
      if (!isGrid && !place) continue;
      const x = this.scene.x(isGrid ? origin[0] + pitch * (at % columns) : place[0]);
      const y = this.scene.y(isGrid ? origin[1] + pitch * Math.floor(at / columns) : place[1]);
      this.scene.arrow(context, x, y, length * tx, length * ty);
    }
    twice(context, 1.4);
  }

  #area() {
    const [left, top, right, bottom] = this.scene.bounds;
    return (right - left) * (bottom - top);
  }

  /** Force and slip margin above or below the contact; the names of its outline and of the zone that sticks. */
  #drawContact(context, contact, patch) {
    if (!contact.position.every(Number.isFinite)) return;
    const { scene } = this;
    const [x, y] = contact.position.map((metres, axis) => (axis ? scene.y(metres) : scene.x(metres)));
    const radius = scene.scale * Math.sqrt(patch?.area / Math.PI) || 10;
    const stick = patch?.stick * radius;
    if (stick > 0) {
      context.beginPath();
      context.arc(x, y, stick, 0, 7);
      context.setLineDash([5, 4]);
      twice(context, 2);
      context.setLineDash([]);
      if (stick > STICK_LABEL_PX) scene.label(context, "sticks inside", x, y + stick - 12);
    }
    const edge = OUTSIDE * radius;
    const above = y - edge - 44 > scene.y(scene.bounds[1]);
    const first = above ? y - edge - 32 : y + edge + 14;
    const [force, slip] = this.texts.get(contact.id) ?? texts(contact);
    scene.label(context, force, x, first, theme.ink, BOLD);
    if (slip) scene.label(context, `slip margin ${slip.text}`, x, first + 20, slip.kind === "bad" ? theme.bad : theme.ink);
    if (patch) scene.label(context, `contact ${contact.id}`, x + 0.75 * edge, y + (above ? 0.75 : -0.75) * edge);
  }

  /** Scale and legend, a few times a second. */
  describe(model) {
    const { unit, name, signed } = LAYERS[this.layer];
    const decoded = model.newest("decoded");
    const truth = model.truths.length > 0;
    this.texts = new Map(model.newest("contacts")?.contacts.map((contact) => [contact.id, texts(contact)]));
    for (const option of this.select.options) {
      option.disabled =
        (option.value === "error" && !truth) ||
        (option.value === "std" && !decoded?.std) ||
        (option.value === "displacement" && !decoded?.displacement);
    }
    if (this.select.selectedOptions[0]?.disabled && decoded) {
      this.select.value = "traction";
      this.#choose("traction");
    }
    const ends = [signed ? -this.top : 0, signed ? 0 : this.top / 2, this.top];
    this.root.querySelectorAll(".scale span").forEach((span, index) => setText(span, unit(ends[index])));
    const arrows = !this.arrows.checked ? "no arrows" : this.longest > 0 ? `longest arrow ${pascals(this.longest)}` : "no shear above its noise";
    const legend = this.hasContact ? `outline: ${100 * OUTLINE} % of the peak; ${arrows}` : "";
    setText(this.root.querySelector(".longest"), this.relief.isShown ? this.relief.describe(name, decoded?.displacement === null) : legend);
    const summary = model.newest("decoded/summary");
    const parts = summary ? [summary.decoder, summary.reason || summary.status] : [];
    if (summary?.atBorder) parts.push("contact reaches the border: larger errors");
    const caption = this.root.querySelector(".caption");
    setText(caption, parts.filter(Boolean).join(" · ") || (model.isOffline ? "" : "No decoded map was published yet."));
    if (caption.title !== caption.textContent) caption.title = caption.textContent; // where it is cut off
    this.scene.canvas.setAttribute("aria-label", this.#summary(model, name, unit));
  }

  #summary(model, name, unit) {
    const contacts = model.newest("contacts")?.contacts.length ?? 0;
    return `Map of ${name}: largest value ${unit(this.peak ?? NaN)}, ${contacts} contact${contacts === 1 ? "" : "s"}`;
  }
}
