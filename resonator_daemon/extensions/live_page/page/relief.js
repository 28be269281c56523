// Panel of the relief: switch, loading of three.js, rotation, text alternative.

import { metres, roundBelow, setText } from "./text.js";

const KEYS = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }; // degrees
const DEGREES_PER_PX = 0.5;
const START = { azimuth: -20, elevation: 40 };
const ELEVATIONS = [20, 90]; // from the side, from above; lower, rays of the picture's upper edge would miss the plate
const HIGHEST = 0.22; // of the plate's size: the exaggerated depth at most
const LEAST = 100e-6; // m: smaller displacements are not exaggerated further
const ALIKE = 1.05; // ratio of the largest displacements up to which two presses get one exaggeration
const NO_WEBGL = "The relief needs WebGL 2, which this browser does not have. Enable hardware acceleration in its settings; the flat map has the same values.";

export class ReliefPanel {
  #scene = null;
  #held = new Map(); // pointers on the picture, by id: the newest event of each
  #isTurning = false; // whether they turn it

  /** `onChange` is called when the relief has to be drawn, or the flat map in its place. */
  constructor(root, onChange) {
    this.root = root;
    this.onChange = onChange;
    this.canvas = root.querySelector(".relief canvas");
    this.switch = root.querySelector(".relief-switch");
    this.note = root.querySelector(".relief-note");
    this.exaggeration = 1;
    this.depth = NaN;
    this.switch.addEventListener("change", () => this.#choose());
    this.#turnTo(START);
    this.#follow();
  }

  get isShown() {
    return this.#scene !== null && this.switch.checked;
  }

  async #choose() {
    let text = "";
    if (this.switch.checked && !this.#scene) {
      setText(this.note, "Loading the relief…");
      text = await this.#load();
    }
    setText(this.note, text);
    if (text) this.switch.checked = false;
    this.root.classList.toggle("in-relief", this.isShown);
    this.root.querySelector(".relief").hidden = !this.isShown;
    this.root.querySelector("canvas.scene").hidden = this.isShown;
    this.onChange();
  }

  /** Return why the relief cannot be shown, "" if it can. */
  async #load() {
    const context = this.canvas.getContext("webgl2", { antialias: true });
    if (!context) return NO_WEBGL;
    try {
      const { ReliefScene } = await import("./relief_scene.js");
      if (!this.root.isConnected) return ""; // removed meanwhile
      this.#scene ??= new ReliefScene(this.canvas, context, this.root.querySelector(".relief-labels"), this.onChange);
      return "";
    } catch (error) {
      return `The relief cannot be shown: ${error.message}`;
    }
  }

  remove() {
    this.#scene?.dispose();
    this.#scene = null;
  }

  #turnTo({ azimuth, elevation }) {
    this.azimuth = ((((azimuth + 180) % 360) + 360) % 360) - 180;
    this.elevation = Math.max(ELEVATIONS[0], Math.min(ELEVATIONS[1], elevation));
    this.canvas.dataset.azimuth = Math.round(this.azimuth);
    this.canvas.dataset.elevation = Math.round(this.elevation);
    this.onChange();
  }

  #turn(right, up) {
    this.#turnTo({ azimuth: this.azimuth + right, elevation: this.elevation + up });
  }

  /** Rotate by keys, two fingers and the right button; by any pointer if the plate cannot be pressed. */
  #follow() {
    const { canvas } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      this.#held.set(event.pointerId, event);
      this.#isTurning ||= event.button === 2 || this.#held.size > 1 || !canvas.closest(".pressable");
      if (!this.#isTurning) return;
      canvas.setPointerCapture(event.pointerId);
      event.stopImmediatePropagation(); // a second finger does not press
      if (this.#held.size > 1) canvas.dispatchEvent(new Event("turn")); // ends the press of the first
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = this.#held.get(event.pointerId);
      if (!last) return;
      this.#held.set(event.pointerId, event);
      const degrees = DEGREES_PER_PX / this.#held.size; // the mean of the fingers counts
      if (this.#isTurning) this.#turn(-degrees * (event.clientX - last.clientX), degrees * (event.clientY - last.clientY));
    });
    for (const type of ["pointerup", "pointercancel", "pointerleave", "lostpointercapture"]) {
      canvas.addEventListener(type, ({ pointerId }) => {
        this.#held.delete(pointerId);
        this.#isTurning &&= this.#held.size > 0;
      });
    }
    // Without this, two fingers scroll the page if the plate cannot be pressed.
    canvas.addEventListener("touchstart", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "Home") this.#turnTo(START);
      else if (KEYS[event.key]) this.#turn(...KEYS[event.key]);
      else return;
      event.preventDefault();
      event.stopImmediatePropagation(); // the keys that press a plate are others
    });
  }

  /** Position in metres of a pointer event, in the plane of the untouched skin. */
  position(event) {
    return this.#scene.position(event);
  }

  /** The plate that is shown, and points in metres that its picture contains. */
  setPlate(info, points) {
    const [xs, ys] = [0, 1].map((axis) => (points.length ? points.map((point) => point[axis]) : [-0.01, 0.01]));
    this.bounds = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    this.info = info;
    this.exaggeration = 1;
    this.before = 1; // exaggeration of the last press
    this.isPress = false;
  }

  /**
   * Draw a map and what lies on it.
   *
   * map: null, or {rows, columns, pitch, corner, depths, pixels}: of each pixel the displacement into the plate in m, NaN
   * where it is not known, and the colour; corner is the position of the first. labels: [{position, text, kind}].
   */
  draw(map, labels, presses) {
    let largest = 0;
    this.depth = map ? 0 : NaN;
    for (const value of map?.depths ?? []) {
      this.depth = value > this.depth ? value : this.depth;
      largest = Math.abs(value) > largest ? Math.abs(value) : largest;
    }
    if (map) this.#exaggerate(largest, labels.some(({ kind }) => kind === "contact"));
    this.#scene.draw(this, map, labels, presses);
  }

  /** Choose the exaggeration by the largest displacement in m since the first contact began; without contact, keep it if it fits. */
  #exaggerate(largest, hasContact) {
    const [left, top, right, bottom] = this.bounds;
    const height = HIGHEST * Math.max(right - left, bottom - top);
    const isPress = hasContact || this.exaggeration * largest > ALIKE * height;
    if (isPress && !this.isPress) [this.before, this.largest] = [this.exaggeration, LEAST];
    this.isPress = isPress;
    if (!isPress) return;
    this.largest = Math.max(this.largest, largest);
    const most = height / this.largest;
    const [less, here, more] = [most / ALIKE, most, most * ALIKE].map((limit) => roundBelow(Math.max(1, limit)));
    this.exaggeration = [less, more].includes(this.before) ? this.before : here;
  }

  /** Return the line below the picture, and write the canvas' text alternative. */
  describe(layer, lacksDisplacement) {
    const absence = lacksDisplacement ? "no displacement was published: [decoding] displacement = true publishes it" : "no map";
    const height = Number.isFinite(this.depth) ? `height × ${this.exaggeration}, deepest ${metres(1e-6 * Math.round(1e6 * this.depth))}` : absence;
    const view = `seen from ${this.canvas.dataset.azimuth}° to the side and ${this.canvas.dataset.elevation}° above`;
    const label = `Relief of the skin, coloured by ${layer}: ${height}; ${view}. Arrow keys turn it, Home turns it back.`;
    if (this.canvas.getAttribute("aria-label") !== label) this.canvas.setAttribute("aria-label", label);
    return height;
  }
}
