// What one plate of one source has published last. Streams are decoded when they are drawn, not when they arrive.

import { readPayload } from "./payloads.js";
import { isMeasured } from "./text.js";

const HISTORY_S = 60;
const HISTORY_POINTS = 1200;
const EVENTS = 50;
const TRUTHS = 64;
const STALE_S = 1.5;
export const TRAIL_S = 2;
const TRAIL_STEP_S = 0.04;
export const STREAMS = ["forces", "contacts", "tones", "decoded", "decoded/summary", "health"];

/** Force over the last minute, oldest first: rows of time, normal force, its standard deviation, shear, true force. */
class History {
  constructor() {
    this.rows = Array.from({ length: 5 }, () => new Float64Array(HISTORY_POINTS));
    this.length = 0;
    this.version = 0;
  }

  clear() {
    this.length = 0;
    this.version += 1;
  }

  add(time, ...values) {
    const last = this.length ? this.rows[0][this.length - 1] : -Infinity;
    if (time < last || time - last > HISTORY_S) this.length = 0;
    else if (time - last < HISTORY_S / HISTORY_POINTS) return;
    if (this.length === HISTORY_POINTS) {
      for (const row of this.rows) row.copyWithin(0, 1);
      this.length -= 1;
    }
    this.rows[0][this.length] = time;
    values.forEach((value, index) => (this.rows[index + 1][this.length] = value));
    this.length += 1;
    this.version += 1;
  }
}

export class PlateModel {
  constructor(source, name) {
    this.source = source;
    this.name = name;
    this.info = null;
    this.states = {};
    this.unreadable = 0;
    this.truths = [];
    this.infoVersion = 0;
    this.#clearRun("");
  }

  #clearRun(run) {
    this.run = run;
    this.streams = {};
    this.events = [];
    this.eventVersion = 0;
    this.history = new History();
    this.trails = new Map(); // by contact: {time, position}, oldest first
    this.health = null;
    this.previousHealth = null;
    this.arrived = -Infinity;
    this.version = (this.version ?? 0) + 1;
  }

  /** Store a message. An empty payload is a retained topic that was cleared. */
  receive(path, bytes, nowMs) {
    if (bytes.length === 0) {
      if (path === "info") this.info = null, (this.infoVersion += 1);
      else if (path.startsWith("state/")) delete this.states[path.slice(6)];
      if (!this.info && !Object.keys(this.states).length) this.#clearRun("");
      this.version += 1;
      return;
    }
    if (STREAMS.includes(path) && path !== "health") {
      const stream = (this.streams[path] ??= { bytes: null, payload: null, received: 0 });
      stream.bytes = bytes.slice();
      stream.received += 1;
      this.arrived = nowMs;
      this.version += 1;
      return;
    }
    const payload = this.#read(path, bytes);
    if (!payload) return;
    this.version += 1;
    if (path === "info") this.info = payload, (this.infoVersion += 1);
    else if (path === "health") this.previousHealth = this.health, (this.health = payload);
    else if (path.startsWith("state/")) this.#setState(path.slice(6), payload);
    else if (path === "contacts/event") {
      this.events.unshift(payload);
      this.events.length = Math.min(this.events.length, EVENTS);
      this.eventVersion += 1;
    }
  }

  #setState(part, payload) {
    const before = this.states.daemon;
    if (part === "daemon" && before && !(payload.since > 0)) {
      payload.since = before.state === "offline" ? before.since : Date.now() / 1000; // a last will has no time, and may come again
    }
    this.states[part] = payload;
    if (part === "daemon" && payload.run && payload.run !== this.run) this.#clearRun(payload.run);
    if (part === "daemon" && payload.state === "offline") {
      const { decoded } = this.streams; // the last map stays, and is marked as such
      this.streams = decoded ? { decoded } : {};
      this.health = null;
      this.trails.clear();
    }
  }

  #read(path, bytes) {
    try {
      return readPayload(path, bytes);
    } catch {
      this.unreadable += 1;
      return null;
    }
  }

  /** Remove what came before a jump in a recording. */
  clearPast() {
    this.history.clear();
    this.trails.clear();
    this.events = [];
    this.eventVersion += 1;
  }

  /** The newest message of a stream, decoded once; null before the first. */
  newest(path) {
    const stream = this.streams[path];
    if (stream?.bytes) {
      stream.payload = this.#read(path, stream.bytes) ?? stream.payload;
      stream.bytes = null;
    }
    return stream?.payload ?? null;
  }

  addTruth(truth) {
    this.truths.push(truth);
    if (this.truths.length > TRUTHS) this.truths.shift();
    this.version += 1;
  }

  /** What the emulator applied at a time, between two messages of it; null before the oldest, and where nothing is emulated. */
  truthAt(time) {
    const { truths } = this;
    const after = truths.findIndex((truth) => truth.time >= time);
    if (after < 0) return truths[truths.length - 1] ?? null;
    return after ? between(truths[after - 1], truths[after], time) : null;
  }

  /** Add the newest contacts to the history. */
  sample() {
    const contacts = this.newest("contacts");
    if (!contacts || !(contacts.time > 0) || contacts === this.sampled) return;
    this.sampled = contacts;
    this.#trace(contacts);
    let normal = contacts.contacts.length || isMeasured(contacts) ? 0 : NaN; // a gap in the curve
    let variance = 0;
    let x = normal;
    let y = normal;
    for (const { force, noise, systematic } of contacts.contacts) {
      normal += force[2];
      variance += noise[2] ** 2 + (systematic || 0) ** 2;
      x += force[0];
      y += force[1];
    }
    const truth = this.truthAt(contacts.time);
    const applied = truth ? truth.contacts.reduce((sum, touch) => sum + (touch.force[2] || 0), 0) : NaN;
    this.history.add(contacts.time, normal, Math.sqrt(variance), Math.hypot(x, y), applied);
  }

  #trace({ time, contacts }) {
    for (const [id, trail] of this.trails) {
      while (trail.length && !(Math.abs(time - trail[0].time) < TRAIL_S)) trail.shift();
      if (!trail.length) this.trails.delete(id);
    }
    for (const { id, position } of contacts) {
      if (!position.every(Number.isFinite)) continue;
      if (!this.trails.has(id)) this.trails.set(id, []);
      const trail = this.trails.get(id);
      if (!(time - trail.at(-1)?.time < TRAIL_STEP_S)) trail.push({ time, position });
    }
  }

  isStale(nowMs) {
    return nowMs - this.arrived > STALE_S * 1000;
  }

  get isOffline() {
    return this.states.daemon?.state === "offline";
  }

  /** Numbers of the sites that contradict all others. */
  get suspects() {
    return this.isOffline ? [] : (this.states.sensor?.suspects ?? []);
  }

  get isSkin() {
    return Boolean(this.info?.skin);
  }
}

/** The later of two truths, with forces and positions of touches that both have as of a time between them. */
function between(before, after, time) {
  const share = (time - before.time) / (after.time - before.time);
  const mix = (from, to) => to.map((value, index) => from[index] + share * (value - from[index]));
  const contacts = after.contacts.map((touch) => {
    const from = before.contacts.find(({ id }) => id === touch.id);
    if (!from || !(share >= 0 && share <= 1)) return touch;
    const radius = from.radius + share * (touch.radius - from.radius);
    return { ...touch, force: mix(from.force, touch.force), position: mix(from.position, touch.position), radius };
  });
  return { ...after, contacts };
}
