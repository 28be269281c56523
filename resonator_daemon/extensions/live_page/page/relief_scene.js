// What the relief draws with three.js: the shaded surface, the plate's outline, a scale of depth, presses, and labels.

import { theme } from "./colours.js";
import { isArea } from "./marks.js";
import { make, metres, roundBelow, setText } from "./text.js";
import {
  AmbientLight, BufferAttribute, BufferGeometry, ColorManagement, DirectionalLight, DoubleSide, LineBasicMaterial, LineLoop,
  LineSegments, LinearSRGBColorSpace, Mesh, MeshLambertMaterial, PerspectiveCamera, Plane, Raycaster, Scene, Vector2, Vector3, WebGLRenderer,
} from "./three/three.module.min.js";

const VIEW_DEGREES = 30;
const AMBIENT = 0.62 * Math.PI; // a share of the light that shows a colour as the scale has it
const DIRECTED = 0.5 * Math.PI;
const CROSS = 0.03; // of the plate's size: half of a press's cross
const SCALE = 0.15; // of it: the scale of depth at most
const ASIDE = 0.05; // of it: distance of the axes from the plate
const HEAD = 0.03; // of it: the heads of the axes, towards larger values
const STEM = 0.2; // of it: how high the force of a contact stands above it
const MESH_LINES = 16; // along each side, at most
const RADIANS = Math.PI / 180;
const UNTOUCHED = new Plane(new Vector3(0, 1, 0));

ColorManagement.enabled = false; // colours are those of the flat map

/** Lines between points that change. */
const lines = (Kind, isOnTop) => {
  const found = new Kind(new BufferGeometry(), new LineBasicMaterial({ depthTest: !isOnTop }));
  found.frustumCulled = false;
  found.renderOrder = isOnTop ? 1 : 0;
  return found;
};

function setPoints(object, points) {
  const { geometry } = object;
  const values = new Float32Array(points.flat());
  if (geometry.attributes.position?.array.length === values.length) {
    geometry.attributes.position.array.set(values);
    geometry.attributes.position.needsUpdate = true;
  } else {
    geometry.dispose();
    geometry.setAttribute("position", new BufferAttribute(values, 3));
  }
  object.visible = points.length > 0;
}

/** Distance of a point from the edge of an outline, negative outside; 1 where the outline has no area. */
function depthInside([x, y], outline) {
  if (!isArea(outline)) return 1;
  let [least, isInside] = [Infinity, false];
  outline.forEach(([x1, y1], index) => {
    const [x0, y0] = outline.at(index - 1);
    const [dx, dy] = [x1 - x0, y1 - y0];
    const share = Math.max(0, Math.min(1, ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1)));
    least = Math.min(least, Math.hypot(x - x0 - share * dx, y - y0 - share * dy));
    if (y0 > y !== y1 > y && x < x0 + (dx * (y - y0)) / dy) isInside = !isInside;
  });
  return isInside ? least : -least;
}

/** Make a material leave out what lies outside of the outline: where the attribute `inside` is negative. */
function cutOff(material) {
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader.replace("void main() {", "attribute float inside; varying float vInside; void main() { vInside = inside;");
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", "varying float vInside; void main() { if (vInside < 0.0) discard;");
  };
}

/** Triangles over a grid of heights, with lines that show its shape; left out: what has an unknown corner or is outside of the outline. */
class Surface {
  constructor({ rows, columns, pitch, corner }, outline) {
    this.outline = outline;
    Object.assign(this, { rows, columns, pitch: 1e3 * pitch, corner: [...corner] });
    const count = rows * columns;
    this.heights = new Float32Array(count);
    const geometry = new BufferGeometry();
    const [places, normals] = [new Float32Array(3 * count), new Float32Array(3 * count)];
    const inside = new BufferAttribute(new Float32Array(count), 1);
    for (let at = 0; at < count; at++) {
      places[3 * at] = 1e3 * corner[0] + this.pitch * (at % columns);
      places[3 * at + 2] = 1e3 * corner[1] + this.pitch * Math.floor(at / columns);
      inside.array[at] = depthInside([places[3 * at] / 1e3, places[3 * at + 2] / 1e3], outline);
    }
    geometry.setAttribute("position", new BufferAttribute(places, 3));
    geometry.setAttribute("normal", new BufferAttribute(normals, 3));
    geometry.setAttribute("color", new BufferAttribute(new Uint8Array(4 * count), 4, true));
    geometry.setAttribute("inside", inside);
    geometry.setIndex(new BufferAttribute(new Uint32Array(6 * Math.max(0, (rows - 1) * (columns - 1))), 1));
    const material = new MeshLambertMaterial({ vertexColors: true, side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.stride = Math.ceil(Math.max(rows, columns) / MESH_LINES);
    this.lines = lines(LineSegments, false);
    Object.assign(this.lines.material, { transparent: true, opacity: 0.3 });
    this.lines.geometry.setAttribute("position", geometry.attributes.position);
    this.lines.geometry.setIndex(new BufferAttribute(new Uint32Array(4 * count), 1));
    this.lines.geometry.setAttribute("inside", inside);
    cutOff(material);
    cutOff(this.lines.material);
    this.mesh.add(this.lines);
  }

  fits({ rows, columns, pitch, corner }, outline) {
    return outline === this.outline && rows === this.rows && columns === this.columns && 1e3 * pitch === this.pitch && corner.every((value, axis) => value === this.corner[axis]);
  }

  set({ depths, pixels }, exaggeration) {
    const { heights, rows, columns } = this;
    const { position, normal, color } = this.mesh.geometry.attributes;
    color.array.set(new Uint8Array(pixels.buffer));
    for (let at = 0; at < heights.length; at++) heights[at] = pixels[at] ? -1e3 * exaggeration * depths[at] : NaN;
    let [used, linesUsed] = [0, 0];
    const { index } = this.mesh.geometry;
    const drawn = this.lines.geometry.index;
    const join = (...ends) => {
      if (!ends.some((end) => Number.isNaN(heights[end]))) for (const end of ends) drawn.array[linesUsed++] = end;
    };
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const at = row * columns + column;
        const height = heights[at];
        position.array[3 * at + 1] = height || 0;
        const known = (other, isInside) => (isInside && heights[other] === heights[other] ? other : at);
        const [west, east] = [known(at - 1, column > 0), known(at + 1, column + 1 < columns)];
        const [north, south] = [known(at - columns, row > 0), known(at + columns, row + 1 < rows)];
        normal.array[3 * at] = (heights[west] - heights[east]) / (this.pitch * (east - west)) || 0;
        normal.array[3 * at + 1] = 1;
        normal.array[3 * at + 2] = ((heights[north] - heights[south]) * columns) / (this.pitch * (south - north)) || 0;
        if (row % this.stride === 0 && column + 1 < columns) join(at, at + 1);
        if (column % this.stride === 0 && row + 1 < rows) join(at, at + columns);
        const corners = [at, at + columns, at + 1, at + columns + 1];
        if (row + 1 === rows || column + 1 === columns || corners.some((corner) => Number.isNaN(heights[corner]))) continue;
        for (const corner of [0, 1, 2, 2, 1, 3]) index.array[used++] = corners[corner];
      }
    }
    this.mesh.geometry.setDrawRange(0, used);
    this.lines.geometry.setDrawRange(0, linesUsed);
    for (const attribute of [position, normal, color, index, drawn]) attribute.needsUpdate = true;
  }

  /** Height in mm at a position in m; that of the untouched skin where it is not known. */
  heightAt([x, y]) {
    const column = Math.round((1e3 * (x - this.corner[0])) / this.pitch);
    const row = Math.round((1e3 * (y - this.corner[1])) / this.pitch);
    return column < 0 || column >= this.columns || row < 0 ? 0 : this.heights[row * this.columns + column] || 0;
  }

  dispose() {
    for (const { geometry, material } of [this.mesh, this.lines]) geometry.dispose(), material.dispose();
  }
}

/** Axes next to the edges nearest to the viewer, and a line down from the outline that is as long as a round depth: points, labels. */
function scaleOf([left, top, right, bottom], outline, azimuth, size, exaggeration) {
  const depth = roundBelow((SCALE * size) / exaggeration);
  const [toX, toZ] = [Math.sin(azimuth * RADIANS), Math.cos(azimuth * RADIANS)]; // where the viewer is
  const [west, north, east, south] = [left, top, right, bottom].map((metres) => 1e3 * metres);
  const [x, z] = [toX > 0 ? east + ASIDE * size : west - ASIDE * size, toZ >= 0 ? south + ASIDE * size : north - ASIDE * size];
  const corners = outline.length ? outline : [[toX > 0 ? right : left, toZ >= 0 ? bottom : top]];
  const nearness = ([cornerX, cornerY]) => toX * cornerX + toZ * cornerY;
  const [footX, footZ] = corners.reduce((best, corner) => (nearness(corner) > nearness(best) ? corner : best)).map((metres) => 1e3 * metres);
  const head = HEAD * size;
  const axis = (name, from, to) => `${name} ${Number(from.toFixed(1))} to ${Number(to.toFixed(1))} mm`.replaceAll("-", "−");
  return [
    [
      ...[[footX, 0, footZ], [footX, -depth * exaggeration, footZ], [west, 0, z], [east, 0, z], [x, 0, north], [x, 0, south]],
      ...[-1, 1].flatMap((side) => [[east, 0, z], [east - head, 0, z + (side * head) / 2], [x, 0, south], [x + (side * head) / 2, 0, south - head]]),
    ],
    [
      { text: `${metres(1e-3 * depth)} deep`, kind: "axis", place: [footX, -depth * exaggeration, footZ] },
      { text: axis("x", west, east), kind: "axis", place: [(west + east) / 2, 0, z] },
      { text: axis("y", north, south), kind: "axis", place: [x, 0, (north + south) / 2] },
    ],
  ];
}

export class ReliefScene {
  #width = 0;
  #height = 0;

  /** x of the plate is x, y is z, and out of the plate is y, all in mm; `onChange` is called when the size changes. */
  constructor(canvas, context, labels, onChange) {
    this.canvas = canvas;
    this.labels = labels;
    this.sizes = new WeakMap(); // of the elements in it
    this.renderer = new WebGLRenderer({ canvas, context });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.camera = new PerspectiveCamera(VIEW_DEGREES);
    const light = new DirectionalLight(0xffffff, DIRECTED);
    light.position.set(-1, 1.2, 0.4); // from the upper left of the picture
    this.camera.add(light);
    this.outline = lines(LineLoop, false);
    this.scale = lines(LineSegments, true);
    this.presses = lines(LineSegments, true);
    this.surface = null;
    this.scene = new Scene();
    this.scene.add(new AmbientLight(0xffffff, AMBIENT), this.camera, this.outline, this.scale, this.presses);
    this.observer = new ResizeObserver(() => this.#resize() && onChange());
    this.observer.observe(canvas);
  }

  #resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return false;
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    this.renderer.setSize(clientWidth, clientHeight, false);
    [this.#width, this.#height] = [clientWidth, clientHeight];
    return true;
  }

  dispose() {
    this.observer.disconnect();
    for (const object of [this.outline, this.scale, this.presses, this.surface]) (object?.geometry ?? object)?.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  /** Position in metres of a pointer event, in the plane of the untouched skin. */
  position(event) {
    const box = this.canvas.getBoundingClientRect();
    const place = new Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new Raycaster();
    ray.setFromCamera(place, this.camera);
    const { x, z } = ray.ray.intersectPlane(UNTOUCHED, new Vector3()) ?? { x: NaN, z: NaN };
    return [x / 1e3, z / 1e3];
  }

  draw({ info, bounds, azimuth, elevation, exaggeration }, map, labels, presses) {
    if (!this.#width && !this.#resize()) return;
    if (map && !this.surface?.fits(map, info.outline)) {
      if (this.surface) this.scene.remove(this.surface.mesh), this.surface.dispose();
      this.surface = new Surface(map, info.outline);
      this.scene.add(this.surface.mesh);
    }
    if (this.surface) this.surface.mesh.visible = Boolean(map);
    if (map) this.surface.set(map, exaggeration);
    this.#look(bounds, azimuth, elevation);
    const size = 1e3 * Math.max(bounds[2] - bounds[0], bounds[3] - bounds[1]);
    setPoints(this.outline, info.outline.map(([x, y]) => [1e3 * x, 0, 1e3 * y]));
    const placed = labels.map(({ position, ...label }) => {
      const foot = [1e3 * position[0], map ? this.surface.heightAt(position) : 0, 1e3 * position[1]];
      return { ...label, foot, place: label.kind === "contact" ? [foot[0], STEM * size, foot[2]] : foot };
    });
    const [points, names] = scaleOf(bounds, info.outline, azimuth, size, exaggeration);
    setPoints(this.scale, [...points, ...placed.flatMap(({ foot, place }) => (foot === place ? [] : [foot, place]))]);
    const half = CROSS * size;
    const crosses = [...presses].map(({ position: [x, y] }) => [1e3 * x, 1e3 * y]);
    setPoints(this.presses, crosses.flatMap(([x, z]) => [[x - half, 0, z], [x + half, 0, z], [x, 0, z - half], [x, 0, z + half]]));
    this.outline.material.color.set(theme.muted);
    this.scale.material.color.set(theme.ink);
    this.presses.material.color.set(theme.truth);
    this.renderer.render(this.scene, this.camera);
    this.#label([...placed, ...names]);
  }

  #look([left, top, right, bottom], azimuth, elevation) {
    const middle = new Vector3(500 * (left + right), 0, 500 * (top + bottom));
    this.camera.aspect = this.#width / this.#height;
    const half = Math.tan((VIEW_DEGREES / 2) * RADIANS) * Math.min(1, this.camera.aspect);
    const distance = (540 * Math.hypot(right - left, bottom - top)) / half;
    const [turn, rise] = [azimuth * RADIANS, elevation * RADIANS];
    const direction = new Vector3(Math.sin(turn) * Math.cos(rise), Math.sin(rise), Math.cos(turn) * Math.cos(rise));
    this.camera.up.set(-Math.sin(turn) * Math.sin(rise), Math.cos(rise), -Math.cos(turn) * Math.sin(rise)); // defined from above, too
    this.camera.position.copy(middle).addScaledVector(direction, distance);
    this.camera.lookAt(middle);
    this.camera.near = distance / 10;
    this.camera.far = 4 * distance;
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
  }

  /**
   * Elements with text over the picture; hidden from assistive technology, as lists and the canvas' label have the same.
   *
   * Text is moved into the picture. Names of axes, which come last, are also moved below the others.
   */
  #label(labels) {
    const { children } = this.labels;
    while (children.length > labels.length) this.labels.lastChild.remove();
    const boxes = [];
    labels.forEach(({ text, kind, place }, index) => {
      const element = children[index] ?? this.labels.appendChild(make("span"));
      const middle = new Vector3(...place).project(this.camera);
      const box = { x: ((middle.x + 1) / 2) * this.#width, y: ((1 - middle.y) / 2) * this.#height, ...this.#halfSize(element, text, kind) };
      const inside = (value, half, size) => Math.max(half, Math.min(size - half, value));
      if (text) box.x = inside(box.x, box.wide, this.#width);
      const covered = () => boxes.filter((other) => Math.abs(other.x - box.x) < other.wide + box.wide && Math.abs(other.y - box.y) < other.high + box.high);
      for (let found = kind === "axis" ? covered() : []; found.length; found = covered()) {
        box.y = Math.max(...found.map(({ y, high }) => y + high)) + box.high + 1;
      }
      if (text) box.y = inside(box.y, box.high, this.#height), boxes.push(box);
      element.style.left = `${box.x}px`;
      element.style.top = `${box.y}px`;
    });
  }

  /** Set text and kind of a label, and return half of its size in pixels; measured only when they change. */
  #halfSize(element, text, kind) {
    const key = `${kind} ${text}`;
    if (this.sizes.get(element)?.key !== key) {
      element.className = kind;
      setText(element, text);
      this.sizes.set(element, { key, wide: element.offsetWidth / 2, high: element.offsetHeight / 2 });
    }
    return this.sizes.get(element);
  }
}
