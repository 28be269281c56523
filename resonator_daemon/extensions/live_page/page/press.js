// Press an emulated plate by mouse, touch or keys: hold to press harder, drag to shear until it slips.

import { siteAt } from "./plate.js";
import { fixed, setText } from "./text.js";

const START = 0.05; // of the plate's largest force, at once
const PER_SECOND = 0.16; // of it, while held
const FRICTION = 0.5; // the emulator's, where a press names none
const STIFFNESS_PER_SIZE = 3; // N: dragging by the plate's width shears by this much
const BEYOND = 1.02; // of friction, so that the emulator reports a slide
const KEY_STEP = 1 / 40; // of the plate's width
const IN_FLIGHT = 2;
const BETWEEN = ": between sites. Each site measures only its share of the force."; // of plates with one tone a corner
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Presser {
  #touches = new Map();
  #cursor = null;

  /** Touches of one view's plate; `announce` is for screen readers, `output` shows the force. */
  constructor(connection, output, announce) {
    this.connection = connection;
    this.output = output;
    this.announce = announce;
    this.plate = null;
    this.isMoved = false; // marks changed since the last drawing
    window.addEventListener("blur", () => this.releaseAll());
    document.addEventListener("visibilitychange", () => document.hidden && this.releaseAll());
  }

  /** Follow the pointers and keys on a scene. */
  attach(scene) {
    const { canvas } = scene;
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.plate || event.button !== 0) return;
      this.#press(`pointer${event.pointerId}`, scene.position(event));
    });
    canvas.addEventListener("pointermove", (event) => {
      const name = `pointer${event.pointerId}`;
      if (!this.#touches.has(name)) return;
      const box = canvas.getBoundingClientRect();
      const isInside = event.clientX >= box.left && event.clientX <= box.right && event.clientY >= box.top && event.clientY <= box.bottom;
      if (isInside) this.#touches.get(name).pointer = scene.position(event);
      else this.release(name);
    });
    for (const type of ["pointerup", "pointercancel", "pointerleave"]) {
      canvas.addEventListener(type, (event) => this.release(`pointer${event.pointerId}`));
    }
    canvas.addEventListener("turn", () => this.releaseAll()); // of a relief, by a second finger
    canvas.addEventListener("contextmenu", (event) => this.#touches.size && event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.#keyDown(event));
    canvas.addEventListener("keyup", (event) => [" ", "Enter"].includes(event.key) && this.release("keys"));
    canvas.addEventListener("blur", () => this.release("keys"));
  }

  /** The plate to press: {name, info}, null where none can be pressed. */
  setPlate(name, info) {
    if (this.plate?.name === name && this.plate?.info === info) return;
    this.releaseAll();
    this.#cursor = null;
    this.plate = name && info?.outline.length && info.forceMax > 0 ? { name, info } : null;
    if (!this.plate) return;
    const xs = info.outline.map(([x]) => x);
    const ys = info.outline.map(([, y]) => y);
    this.bounds = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    this.size = this.bounds[2] - this.bounds[0];
    this.middle = [(this.bounds[0] + this.bounds[2]) / 2, (this.bounds[1] + this.bounds[3]) / 2];
  }

  #inside([x, y]) {
    const [left, top, right, bottom] = this.bounds;
    return [Math.max(left, Math.min(right, x)), Math.max(top, Math.min(bottom, y))];
  }

  #keyDown(event) {
    if (!this.plate) return;
    const held = this.#touches.get("keys");
    const step = ARROWS[event.key];
    if (step) {
      const from = held ? held.pointer : (this.#cursor ?? this.middle);
      const moved = this.#inside([from[0] + step[0] * this.size * KEY_STEP, from[1] + step[1] * this.size * KEY_STEP]);
      this.isMoved = true;
      if (held) held.pointer = moved;
      else this.#cursor = moved;
    } else if ([" ", "Enter"].includes(event.key)) {
      if (!event.repeat && !held) this.#press("keys", (this.#cursor ??= [...this.middle]));
    } else if (event.key === "Escape") this.releaseAll();
    else return;
    event.preventDefault();
  }

  #press(name, position) {
    const inside = this.#inside(position);
    if (inside[0] !== position[0] || inside[1] !== position[1]) return;
    this.#touches.set(name, { name, position: inside, pointer: inside, force: [0, 0, 0], since: performance.now(), inFlight: 0, slides: false });
    this.announce(`Pressing ${this.plate.name}`);
  }

  release(name) {
    if (!this.#touches.delete(name) || !this.plate) return;
    this.isMoved = true;
    this.connection.request({ release: { plate: this.plate.name, name } });
    this.announce("Released");
  }

  releaseAll() {
    for (const name of [...this.#touches.keys()]) this.release(name);
  }

  get isActive() {
    return this.#touches.size > 0;
  }

  /** What to draw: touches, and the cursor of the keys. */
  *marks() {
    for (const { position, pointer } of this.#touches.values()) yield { position, pointer, isHeld: true };
    if (this.#cursor && !this.#touches.has("keys")) yield { position: this.#cursor, pointer: null, isHeld: false };
  }

  /** Increase the forces, and send what changed; once per drawn frame. */
  advance(nowMs) {
    if (!this.plate) return;
    for (const touch of this.#touches.values()) {
      const { info } = this.plate;
      const share = START + (PER_SECOND * Math.max(0, nowMs - touch.since)) / 1000;
      const normal = info.forceMax * Math.min(1, share);
      touch.force = [0, 0, normal];
      if (info.skin) this.#shear(touch, normal);
      else touch.position = this.#inside(touch.pointer);
      if (touch.inFlight < IN_FLIGHT) this.#send(touch);
    }
  }

  /** A spring from the contact to the pointer; beyond friction the contact follows. */
  #shear(touch, normal) {
    const stiffness = STIFFNESS_PER_SIZE / this.size;
    const drag = [touch.pointer[0] - touch.position[0], touch.pointer[1] - touch.position[1]];
    const length = Math.hypot(...drag);
    const bound = FRICTION * normal;
    const pull = stiffness * length;
    if (pull > BEYOND * bound) {
      const slide = (pull - BEYOND * bound) / pull;
      touch.position = this.#inside([touch.position[0] + slide * drag[0], touch.position[1] + slide * drag[1]]);
    }
    const tangential = Math.min(pull, BEYOND * bound);
    if (length > 0) touch.force = [(tangential * drag[0]) / length, (tangential * drag[1]) / length, normal];
  }

  async #send(touch) {
    touch.inFlight += 1;
    const { name, position, force } = touch;
    const answer = await this.connection.request({ press: { plate: this.plate.name, name, position_m: position, force_newton: force } });
    touch.inFlight -= 1;
    if (this.#touches.get(name) !== touch) return;
    if (!answer.ok) {
      this.#touches.delete(name);
      this.announce(`The press was refused: ${answer.error?.message ?? "no reason given"}`);
      return;
    }
    const slides = answer.slides === true;
    if (slides && !touch.slides) this.announce("The contact slips");
    touch.slides = slides;
  }

  /** Text of the present press, a few times a second. */
  describe() {
    const [touch] = this.#touches.values();
    if (!touch) return setText(this.output, "");
    const [x, y, z] = touch.force;
    const shear = Math.hypot(x, y);
    const parts = [`You press ${fixed(z, 2)} N`];
    if (this.plate.info.skin && shear > 0.005) parts.push(`drag ${fixed(shear, 2)} N`);
    parts.push(`at ${fixed(1e3 * touch.position[0], 1)}, ${fixed(1e3 * touch.position[1], 1)} mm`);
    const { codes, target } = this.plate.info;
    const isBetween = codes.length && target > 0 && siteAt(this.plate.info, touch.position) === null;
    setText(this.output, parts.join(", ") + (isBetween ? BETWEEN : touch.slides ? ": it slips" : ""));
  }
}
