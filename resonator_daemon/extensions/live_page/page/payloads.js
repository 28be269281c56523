// Payloads of the plate's topics, checked once where they arrive: missing, null or odd values become NaN, null or [].

import { decodeCbor } from "./cbor.js";

const TEXT = new TextDecoder();
const MAJOR_VERSION = "2";
const CORNERS = 4;

export const number = (value) => (typeof value === "number" && Number.isFinite(value) ? value : NaN);
const text = (value) => (typeof value === "string" ? value : "");
const list = (value) => (Array.isArray(value) ? value : []);
const object = (value) => (value !== null && typeof value === "object" && !Array.isArray(value) ? value : {});
const vector = (value, length) => Array.from({ length }, (_, index) => number(list(value)[index]));
const points = (value) => list(value).map((point) => vector(point, 2)).filter((point) => point.every(Number.isFinite));

/** Nanoseconds, a decimal string in JSON and a BigInt in CBOR, as seconds. NaN where not known. */
export function seconds(nanoseconds) {
  if (typeof nanoseconds !== "string" && typeof nanoseconds !== "bigint" && typeof nanoseconds !== "number") return NaN;
  return nanoseconds === "" ? NaN : Number(nanoseconds) / 1e9;
}

function counts(value) {
  const found = {};
  for (const [key, count] of Object.entries(object(value))) if (Number.isFinite(count)) found[key] = count;
  return found;
}

/** A float32 array of the expected number of rows, or null. */
function rows(value) {
  const { shape, values } = object(value);
  if (!Array.isArray(shape) || shape.length < 2 || shape[0] !== 3 || !(values instanceof Float32Array)) return null;
  return shape.reduce((product, length) => product * length, 1) === values.length ? { shape, values } : null;
}

function grid(value) {
  const { origin_m, pitch_m, shape } = object(value);
  const origin = vector(origin_m, 2);
  if (!origin.every(Number.isFinite) || !(pitch_m > 0)) return null;
  return { origin, pitch: pitch_m, shape: vector(shape, 2) };
}

function header(payload) {
  return {
    seq: number(payload.seq),
    run: text(payload.daemon_boot_id),
    time: seconds(payload.t_ns),
    timeUncertainty: number(payload.t_uncertainty_ns) / 1e9,
    lost: counts(payload.lost),
    status: text(payload.status),
    reasonCode: text(payload.reason_code),
    reason: text(payload.reason),
  };
}

function contact(value) {
  const payload = object(value);
  return {
    id: payload.id ?? null,
    site: payload.site ?? null,
    position: vector(payload.position_m, 2),
    covariance: vector(payload.position_covariance_m2, 3),
    force: vector(payload.force_newton, 3),
    noise: vector(payload.noise_newton, 3),
    systematic: number(payload.systematic_newton?.[2]),
    atLeast: number(payload.at_least_newton),
    moment: payload.moment_newton_m ? vector(payload.moment_newton_m, 3) : null,
    momentStd: vector(payload.moment_std_newton_m, 3),
    hasSlip: "slip_margin" in payload,
    slipMargin: number(payload.slip_margin),
    slipMarginStd: number(payload.slip_margin_std),
    friction: number(payload.friction_coefficient),
    frictionStd: number(payload.friction_coefficient_std),
    chi2: number(payload.fit?.chi2),
    slipReason: text(payload.slip_reason_code),
    shape: text(payload.shape),
    status: text(payload.status),
    reasonCode: text(payload.reason_code),
    peak: number(payload.peak_newton),
    duration: number(payload.duration_s),
  };
}

function siteForce(value) {
  const payload = object(value);
  return {
    site: payload.site ?? null,
    force: number(payload.force_newton),
    std: Math.hypot(number(payload.noise_newton), number(payload.systematic_newton) || 0),
    bound: number(payload.unobserved_bound_newton),
    atLeast: number(payload.at_least_newton),
    status: text(payload.status),
  };
}

function cornerTone(value) {
  const payload = object(value);
  return {
    captured: text(payload.captured) || "none",
    site: payload.site ?? null,
    frequency: number(payload.frequency_hz),
    noise: number(payload.noise_hz),
    residual: number(payload.residual),
    reasonCode: text(payload.reason_code),
  };
}

const code = (value) => ({ site: object(value).site, f0: vector(object(value).f0_hz, CORNERS), full: vector(object(value).full_load_hz, CORNERS) });

/** Radius in m within which a touch counts as one of a site: 0.4 of the least distance between two, at most 1.5 mm. */
function targetRadius(sites) {
  let least = 0.00375;
  if (sites.length > 256) return NaN; // drawn as dots
  sites.forEach(({ position: [x, y] }, index) => {
    for (const { position } of sites.slice(0, index)) least = Math.min(least, Math.hypot(x - position[0], y - position[1]));
  });
  return 0.4 * least;
}

function info(payload) {
  const version = text(payload.schema_version);
  const calibration = object(payload.calibration);
  const sites = list(payload.sites)
    .map((site) => ({ site: object(site).site, position: vector(object(site).position_m, 2) }))
    .filter((site) => site.position.every(Number.isFinite));
  return {
    ...header(payload),
    supported: version === "" || version.split(".")[0] === MAJOR_VERSION,
    version,
    plate: text(payload.plate),
    link: text(payload.link),
    product: text(payload.product),
    serialNumber: text(payload.serial_number),
    firmware: text(payload.firmware),
    counter: text(payload.counter),
    frameRate: number(payload.frame_rate_hz),
    window: number(payload.window_s),
    rates: counts(payload.rates_hz),
    units: object(payload.units),
    commands: list(payload.commands).filter((verb) => typeof verb === "string"),
    forceMax: payload.force_max_newton > 0 ? payload.force_max_newton : NaN,
    outline: points(payload.outline_m),
    transducers: points(payload.transducers_m),
    sites,
    places: new Map(sites.map(({ site, position }) => [site, position])),
    target: targetRadius(sites),
    grid: grid(payload.grid),
    codes: list(payload.codes).map(code).filter(({ f0, full }) => [...f0, ...full].every(Number.isFinite)),
    pilot: number(payload.pilot_hz),
    skin: payload.skin ? object(payload.skin) : null,
    calibration: {
      id: text(calibration.id),
      date: text(calibration.date),
      expiry: text(calibration.expiry),
      modelError: number(calibration.model_error),
      response: text(calibration.response),
    },
  };
}

function state(payload) {
  const outage = object(payload.last_outage);
  const compensation = object(payload.compensation);
  return {
    ...header(payload),
    state: text(payload.state),
    since: seconds(payload.since_t_ns),
    boots: number(payload.boot_count),
    connections: number(payload.connections),
    connected: seconds(payload.connected_t_ns),
    suspects: list(payload.suspect_sites),
    outage: payload.last_outage ? { end: seconds(outage.end_t_ns), reason: text(outage.reason) } : null,
    compensation: payload.compensation
      ? {
          baseline: text(compensation.baseline),
          commonMode: list(compensation.common_mode).map(number),
          kelvin: number(compensation.plate_kelvin),
          kelvinStd: number(compensation.plate_kelvin_std),
        }
      : null,
  };
}

function health(payload) {
  const latency = {};
  for (const [path, bins] of Object.entries(object(payload.latency))) {
    latency[path] = { bounds: list(object(bins).bounds_ms).map(number), counts: list(object(bins).counts).map(number) };
  }
  const recording = object(payload.recording);
  const decoder = payload.decoder ? object(payload.decoder) : null;
  return {
    ...header(payload),
    uptime: number(payload.uptime_s),
    frameRate: number(payload.frame_rate_hz),
    clockDrift: number(payload.clock_drift_ppm),
    cpu: number(payload.cpu_percent),
    memory: number(payload.rss_mb),
    latency,
    decoder: decoder && { skipped: counts(decoder.skipped), restarts: counts(decoder.restarts), cpu: number(decoder.cpu_percent) },
    recording: { file: text(recording.file), failure: text(recording.failure), bytes: number(recording.file_bytes) },
  };
}

const READERS = {
  info,
  health,
  "state/daemon": state,
  "state/link": state,
  "state/sensor": state,
  forces: (payload) => ({ ...header(payload), window: number(payload.window_s), sites: list(payload.sites).map(siteForce) }),
  contacts: (payload) => ({ ...header(payload), contacts: list(payload.contacts).map(contact) }),
  "contacts/event": (payload) => ({ ...header(payload), event: text(payload.event), contact: contact(payload.contact) }),
  tones: (payload) => ({ ...header(payload), corners: list(payload.corners).slice(0, CORNERS).map(cornerTone) }),
  decoded: (payload) => ({
    ...header(payload),
    traction: rows(payload.traction_pascal),
    std: rows(payload.traction_std_pascal),
    displacement: rows(payload.displacement_m),
    grid: grid(payload.grid),
  }),
  "decoded/summary": (payload) => ({
    ...header(payload),
    decoder: text(payload.decoder),
    atBorder: payload.border_contact === true,
    patches: list(payload.patches).map((value) => {
      const patch = object(value);
      return { id: patch.id ?? null, area: number(patch.area_m2), curvature: number(patch.radius_of_curvature_m), stick: number(patch.stick_ratio) };
    }),
  }),
};

/** Return the checked payload of a topic, null for topics without a reader; throws where the bytes are no payload. */
export function readPayload(path, bytes) {
  const reader = READERS[path];
  if (!reader) return null;
  const payload = bytes[0] === 0x7b ? JSON.parse(TEXT.decode(bytes)) : decodeCbor(bytes);
  if (payload === null || typeof payload !== "object") throw new TypeError(`${path} is not an object`);
  return reader(payload);
}

/** The touches that an emulator applies, checked like a payload. */
export function readTruth(payload) {
  const { plate, t_ns, contacts, traction_pascal } = object(payload);
  return {
    plate: text(plate),
    time: seconds(t_ns),
    contacts: list(contacts).map((value) => {
      const touch = object(value);
      return {
        id: touch.id ?? null,
        site: touch.site ?? null,
        position: vector(touch.position_m, 2),
        force: vector(touch.force_newton, 3),
        radius: number(touch.radius_m),
      };
    }),
    traction: Array.isArray(traction_pascal) ? traction_pascal : null,
  };
}
