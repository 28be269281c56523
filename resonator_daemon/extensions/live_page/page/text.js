// Numbers with units, as people read them; a dash for what is not known.

export const UNKNOWN = "–";

export function fixed(value, digits) {
  if (!Number.isFinite(value)) return UNKNOWN;
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

/** A number with its unit; a dash alone for what is not known. */
export const quantity = (value, digits, unit) => (Number.isFinite(value) ? `${fixed(value, digits)} ${unit}` : UNKNOWN);

/** A size of a file. */
export const bytes = (count) => (count < 1e6 ? quantity(count / 1e3, 0, "kB") : quantity(count / 1e6, 1, "MB"));

/** The largest of … 1, 2, 5, 10, 20 … that is not above a positive number. */
export function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((factor) => factor * power).find((step) => step <= value);
}

/** Decimal places at which a standard deviation has two digits. */
function places(std, fallback) {
  if (!(std > 0)) return fallback;
  return Math.min(4, Math.max(0, 1 - Math.floor(Math.log10(std))));
}

export function plusMinus(value, std, unit, fallback = 2) {
  if (!Number.isFinite(value)) return UNKNOWN;
  const digits = places(std, fallback);
  return `${fixed(value, digits)}${Number.isFinite(std) ? ` ± ${fixed(std, digits)}` : ""} ${unit}`.trim();
}

export function pascals(value) {
  if (!Number.isFinite(value)) return UNKNOWN;
  const size = Math.abs(value);
  if (size >= 1e6) return `${Number((value / 1e6).toPrecision(3))} MPa`;
  return size >= 1e3 ? `${Number((value / 1e3).toPrecision(3))} kPa` : `${Number(value.toPrecision(3))} Pa`;
}

export function metres(value) {
  if (!Number.isFinite(value)) return UNKNOWN;
  return Math.abs(value) >= 1e-3 ? `${Number((value * 1e3).toPrecision(3))} mm` : `${Number((value * 1e6).toPrecision(3))} µm`;
}

export function duration(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  if (whole < 86400) return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
  return `${Math.floor(whole / 86400)} d ${Math.floor((whole % 86400) / 3600)} h`;
}

export function clockTime(seconds) {
  return Number.isFinite(seconds) ? new Date(seconds * 1000).toLocaleTimeString([], { hour12: false }) : UNKNOWN;
}

/** Time of a beginning, with the date unless it is today's. */
export function sinceTime(seconds) {
  const date = new Date(seconds * 1000);
  return `since ${date.toDateString() === new Date().toDateString() ? "" : `${date.toLocaleDateString()} `}${clockTime(seconds)}`;
}

export const words = (code) => code.replaceAll("_", " ");

/** Statuses of a message without contacts that something touches all the same; the site is not known. */
const TOUCHED = new Set(["rejected", "ambiguous", "possibly_more"]);

/** Normal force of a contact with its whole uncertainty. */
export function normalForce({ atLeast, force, noise, systematic }) {
  return Number.isFinite(atLeast) ? `> ${fixed(atLeast, 1)} N` : plusMinus(force[2], Math.hypot(noise[2], systematic || 0), "N");
}

/** What a model without a contact means. */
export function absence(model) {
  const message = model.newest("contacts");
  if (!message) return model.isOffline ? "Contacts are not known: the daemon is offline." : "No contacts were published yet.";
  const { status, reasonCode } = message;
  if (TOUCHED.has(status)) return `Touched, but no site is identified: ${words(reasonCode || status)}. Press on one site, at its centre.`;
  return isMeasured(message) ? "Nothing touches the plate." : `Contacts are not known: ${words(reasonCode || status)}.`;
}

/** Whether the absence of contacts in a message means that the plate is untouched. */
export const isMeasured = ({ status }) => ["ok", "settling", "constraint_dropped", "uncalibrated"].includes(status);

/** Set an element's text only where it differs: unchanged text costs no layout, and is not announced again. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A new element with a class and text. */
export function make(tag, className = "", text = "") {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
}

/** Fill a definition list with [term, description, class] rows, without touching rows that stay as they are. */
export function setRows(list, rows) {
  while (list.children.length > rows.length) list.lastChild.remove();
  rows.forEach(([term, description, className = ""], index) => {
    const row = list.children[index] ?? list.appendChild(make("div"));
    if (!row.firstChild) row.append(make("dt"), make("dd"));
    if (row.className !== className) row.className = className;
    setText(row.firstChild, term);
    setText(row.lastChild, description);
  });
}
