// Colour maps that people with colour-blindness can read, as tables of 256 RGBA words, and the theme's colours.

const ANCHORS = {
  viridis: "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725",
  cividis: "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
  plasma: "0d0887 46039f 7201a8 9c179e bd3786 d8576b ed7953 fb9f3a fdca26 f0f921",
  diverging: "2166ac 4393c3 92c5de d1e5f0 f7f7f7 fddbc7 f4a582 d6604d b2182b",
};

function table(anchors) {
  const colours = anchors.split(" ").map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  const words = new Uint32Array(256);
  for (let index = 0; index < 256; index++) {
    const place = (index / 255) * (colours.length - 1);
    const below = Math.min(Math.floor(place), colours.length - 2);
    const [red, green, blue] = colours[below].map((value, part) =>
      Math.round(value + (place - below) * (colours[below + 1][part] - value)),
    );
    words[index] = (255 << 24) | (blue << 16) | (green << 8) | red;
  }
  return words;
}

export const MAPS = Object.fromEntries(Object.entries(ANCHORS).map(([name, anchors]) => [name, table(anchors)]));

/** CSS colour at a share 0…1 of a map. */
export function css(map, share) {
  const word = map[Math.max(0, Math.min(255, Math.round(share * 255)))];
  return `rgb(${word & 255},${(word >> 8) & 255},${(word >> 16) & 255})`;
}

const NAMES = ["ink", "muted", "line", "plate", "panel", "accent", "truth", "warn", "bad", "site"];
const listeners = new Set();
export const theme = {};

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) theme[name] = style.getPropertyValue(`--${name}`).trim();
}

/** Call `listener` whenever the theme changes between light and dark. */
export function onTheme(listener) {
  listeners.add(listener);
}

export function startTheme() {
  read();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    read();
    for (const listener of listeners) listener();
  });
}
