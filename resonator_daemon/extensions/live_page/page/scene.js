// A canvas in the plate's coordinates: x to the right, y downwards, metres. What does not move is drawn once and kept.

import { onTheme, theme } from "./colours.js";

const MARGIN = { left: 42, top: 4, right: 4, bottom: 34 };
const BORDER = 0.05; // of the plate's size, around it

function niceStep(span, count) {
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= raw);
}

export class Scene {
  #still = document.createElement("canvas");
  #stale = true;

  /** drawStill(context, scene) draws below the axes; it is called again when size, plate or theme change. */
  constructor(canvas, drawStill) {
    this.canvas = canvas;
    // Desynchronized, drawing takes a third less of the main thread: benchmarks/live_page_draws.py of commit a510926e.
    this.context = canvas.getContext("2d", { desynchronized: true });
    this.drawStill = drawStill;
    this.bounds = [-0.01, -0.01, 0.01, 0.01];
    this.width = 0;
    this.height = 0;
    this.changed = true;
    new ResizeObserver(() => this.#resize()).observe(canvas);
    onTheme(() => this.invalidate());
  }

  invalidate() {
    this.#stale = true;
    this.changed = true;
  }

  /** Show the points [x, y] in metres, with a border. */
  show(points) {
    if (!points.length) return;
    let [left, top] = points[0];
    let [right, bottom] = points[0];
    for (const [x, y] of points) {
      left = Math.min(left, x);
      right = Math.max(right, x);
      top = Math.min(top, y);
      bottom = Math.max(bottom, y);
    }
    const border = BORDER * Math.max(right - left, bottom - top, 1e-4);
    this.bounds = [left - border, top - border, right + border, bottom + border];
    this.canvas.parentElement.style.aspectRatio = `${Math.max(0.5, Math.min(2, (right - left) / (bottom - top || 1)))}`;
    this.#place();
    this.invalidate();
  }

  #resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth === this.width && clientHeight === this.height && ratio === this.ratio) return;
    [this.width, this.height, this.ratio] = [clientWidth, clientHeight, ratio];
    this.canvas.width = Math.max(1, Math.round(clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * ratio));
    this.#place();
    this.invalidate();
  }

  #place() {
    const [left, top, right, bottom] = this.bounds;
    const wide = Math.max(1, this.width - MARGIN.left - MARGIN.right);
    const high = Math.max(1, this.height - MARGIN.top - MARGIN.bottom);
    this.scale = Math.min(wide / (right - left), high / (bottom - top));
    this.left = MARGIN.left + (wide - this.scale * (right - left)) / 2 - this.scale * left;
    this.top = MARGIN.top + (high - this.scale * (bottom - top)) / 2 - this.scale * top;
  }

  x(metres) {
    return this.left + this.scale * metres;
  }

  y(metres) {
    return this.top + this.scale * metres;
  }

  /** Position in metres of a pointer event. */
  position(event) {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left - this.left) / this.scale, (event.clientY - box.top - this.top) / this.scale];
  }

  /** Begin a frame: the kept picture. Returns the context, or null while the canvas is not visible. */
  begin() {
    if (this.width < 2 || this.height < 2) return null;
    this.changed = false;
    if (this.#stale) this.#drawStill();
    const context = this.context;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.#still, 0, 0);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.font = FONT;
    context.lineWidth = 1.5;
    context.setLineDash([]);
    return context;
  }

  #drawStill() {
    this.#still.width = this.canvas.width;
    this.#still.height = this.canvas.height;
    const context = this.#still.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.font = FONT;
    this.drawStill(context, this);
    this.#drawAxes(context);
    this.#stale = false;
  }

  #drawAxes(context) {
    const [left, top, right, bottom] = this.bounds.map((metres) => metres * 1e3);
    context.fillStyle = context.strokeStyle = theme.muted;
    context.lineWidth = 1;
    const x0 = this.x(left / 1e3);
    const y0 = this.y(bottom / 1e3);
    context.strokeRect(x0, this.y(top / 1e3), this.x(right / 1e3) - x0, y0 - this.y(top / 1e3));
    const step = niceStep(Math.max(right - left, bottom - top), 6);
    context.beginPath();
    context.textAlign = "center";
    context.textBaseline = "top";
    for (let tick = Math.ceil(left / step); tick * step <= right; tick++) {
      const x = this.x((tick * step) / 1e3);
      context.moveTo(x, y0);
      context.lineTo(x, y0 + 4);
      context.fillText(label(tick * step), x, y0 + 6);
    }
    context.fillText("x (mm) →", (x0 + this.x(right / 1e3)) / 2, y0 + 21);
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let tick = Math.ceil(top / step); tick * step <= bottom; tick++) {
      const y = this.y((tick * step) / 1e3);
      context.moveTo(x0 - 4, y);
      context.lineTo(x0, y);
      context.fillText(label(tick * step), x0 - 6, y);
    }
    context.stroke();
    context.save();
    context.translate(x0 - 34, (y0 + this.y(top / 1e3)) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText("← y (mm), downwards", 0, 0);
    context.restore();
  }

  /** Trace a polygon of points in metres. */
  polygon(context, points) {
    context.beginPath();
    for (const [x, y] of points) context.lineTo(this.x(x), this.y(y));
    context.closePath();
  }

  /** Trace the ellipse of one standard deviation of a covariance [xx, xy, yy] in m²; at least 2 px in each direction. */
  ellipse(context, [x, y], [xx, xy, yy]) {
    const cross = xy || 0;
    const mean = (xx + yy) / 2;
    const spread = Math.hypot((xx - yy) / 2, cross);
    const long = this.scale * Math.sqrt(Math.max(0, mean + spread));
    const short = this.scale * Math.sqrt(Math.max(0, mean - spread));
    context.beginPath();
    context.ellipse(this.x(x), this.y(y), Math.max(2, long), Math.max(2, short), 0.5 * Math.atan2(2 * cross, xx - yy), 0, 7);
  }

  /** An arrow of (dx, dy) pixels that begins at (x, y) pixels, added to the path. */
  arrow(context, x, y, dx, dy) {
    const length = Math.hypot(dx, dy);
    if (!(length > 1)) return;
    const head = Math.min(7, 0.45 * length) / length;
    const [endX, endY] = [x + dx, y + dy];
    context.moveTo(x, y);
    context.lineTo(endX, endY);
    context.moveTo(endX - head * (dx + 0.6 * dy), endY - head * (dy - 0.6 * dx));
    context.lineTo(endX, endY);
    context.lineTo(endX - head * (dx - 0.6 * dy), endY - head * (dy + 0.6 * dx));
  }

  /** Text that stays readable on any colour, inside the canvas. */
  label(context, text, x, y, colour = theme.ink, font = FONT) {
    context.font = font;
    const half = context.measureText(text).width / 2 + 3;
    const inside = Math.max(half, Math.min(this.width - half, x));
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.strokeStyle = theme.panel;
    context.lineWidth = 4;
    context.lineJoin = "round";
    context.strokeText(text, inside, y);
    context.fillStyle = colour;
    context.fillText(text, inside, y);
    context.lineWidth = 1.5;
  }
}

const FONT = "12px system-ui, sans-serif";
export const BOLD = "600 17px system-ui, sans-serif"; // for what matters most
const label = (value) => String(Number(value.toFixed(6))).replace("-", "−");
