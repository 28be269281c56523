// What the pictures of force plates and of skins have in common: outline, transducers, paths, suspects, truth, presses.

import { theme } from "./colours.js";
import { TRAIL_S } from "./plate_model.js";
import { fixed } from "./text.js";

const TWICE = [["#000a", 2], ["#fff", 0]]; // colours of a line, and how much wider it is

/** What a picture of the plate shows, as points in metres. */
export const extent = ({ outline, transducers, sites }) => [...outline, ...transducers, ...sites.map(({ position }) => position)];

/** Whether an outline encloses an area, to which a map is cut. */
export const isArea = (outline) => outline.length > 2;

export function circle(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 7);
}

export function drawOutline(context, scene, { outline }) {
  if (!outline.length) return;
  scene.polygon(context, outline);
  context.fillStyle = theme.plate;
  context.fill();
  context.strokeStyle = theme.muted;
  context.lineWidth = 1.5;
  context.stroke();
}

export function drawTransducers(context, scene, { transducers }) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.strokeStyle = theme.accent;
  context.lineWidth = 1.5;
  transducers.forEach(([x, y], index) => {
    context.fillStyle = theme.panel;
    context.beginPath();
    context.rect(scene.x(x) - 9, scene.y(y) - 9, 18, 18);
    context.fill();
    context.stroke();
    context.fillStyle = theme.accent;
    context.fillText(`${index + 1}`, scene.x(x), scene.y(y));
  });
}

/** The path of each contact over the last seconds: the older, the fainter. */
export function drawTrails(context, scene, { trails, sampled }) {
  for (const [colour, width] of TWICE) {
    context.strokeStyle = colour;
    context.lineWidth = width + 2;
    for (const trail of trails.values()) {
      for (let at = 1; at < trail.length; at++) {
        context.beginPath();
        for (const { position } of [trail[at - 1], trail[at]]) context.lineTo(scene.x(position[0]), scene.y(position[1]));
        context.globalAlpha = Math.max(0, 1 - (sampled.time - trail[at].time) / TRAIL_S);
        context.stroke();
      }
    }
  }
  context.globalAlpha = 1;
}

/** Sites that contradict all others: crossed out, and named. */
export function drawSuspects(context, scene, { places }, suspects) {
  for (const site of suspects) {
    const position = places.get(site);
    if (!position) continue;
    const [x, y] = [scene.x(position[0]), scene.y(position[1])];
    circle(context, x, y, 9);
    context.moveTo(x - 6, y + 6);
    context.lineTo(x + 6, y - 6);
    context.strokeStyle = theme.panel;
    context.lineWidth = 6;
    context.stroke();
    context.strokeStyle = theme.warn;
    context.lineWidth = 2.5;
    context.stroke();
    scene.label(context, `site ${site} suspect`, x, y - 18, theme.warn);
  }
}

/** Stroke a path that is readable on dark and on bright colours. */
export function twice(context, width) {
  for (const [colour, wider] of TWICE) {
    context.strokeStyle = colour;
    context.lineWidth = width + wider;
    context.stroke();
  }
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
