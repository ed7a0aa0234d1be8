// Names of drones, numbers of gates and the direction of north over the scene. They are drawn with
// it: elements of the page would be painted and composited one by one in every frame.
import {
  BufferAttribute, CanvasTexture, DynamicDrawUsage, InstancedBufferAttribute,
  InstancedBufferGeometry, Mesh, ShaderMaterial, SRGBColorSpace, Vector2, Vector3,
} from "three";
import { SCENE, flightColor } from "./colors.js";

const CLEAR = [90, 13]; // px between names; of nearer ones only one is shown
const [WIDTH, HEIGHT, ROWS] = [200, 18, 100]; // px of a cell of the texture; cells in a column
const DOT = 14; // px, width of a label's dot
const MOST = 500; // labels

const VERTEX = `
attribute vec2 place, size; // px
attribute vec4 cell;
uniform vec2 resolution;
varying vec2 at;
void main() {
  vec2 pixel = place + size * position.xy;
  gl_Position = vec4(2.0 * pixel.x / resolution.x - 1.0, 1.0 - 2.0 * pixel.y / resolution.y, 0, 1);
  at = cell.xy + cell.zw * vec2(position.x, -position.y);
}`;
const FRAGMENT = `
uniform sampler2D texts;
varying vec2 at;
void main() {
  gl_FragColor = texture2D(texts, at);
  #include <colorspace_fragment>
}`;

// Gates at one place share a label: above the opening, or beside it as seen from above.
function gateLabels(gates) {
  const groups = [];
  gates.forEach((gate, index) => {
    const center = new Vector3(...gate.center);
    const above = center.clone().addScaledVector(gate.down, -gate.size[1] / 2 - 0.28);
    const beside = center.clone().addScaledVector(gate.right, gate.size[0] / 2 + 0.3);
    const near = groups.find((group) => group.above.distanceTo(above) < 0.5);
    if (near) near.names.push(index + 1);
    else groups.push({ above, beside, names: [index + 1] });
  });
  return groups.map(({ names, ...places }) => ({ ...places, text: names.join(", ") }));
}

function shortened(context, text, width) {
  let short = text.slice(0, 80);
  if (short === text && context.measureText(short).width <= width) return short;
  while (short && context.measureText(`${short}…`).width > width) short = short.slice(0, -1);
  return `${short}…`;
}

export class Labels {
  constructor(scene, flights, gates, { center, high }) {
    this.shown = true;
    this.selected = 0;
    this.point = new Vector3();
    const north = new Vector3(Math.ceil(high.x) + 0.8, 0, center.z);
    const fixed = [...gateLabels(gates), { above: null, beside: north, text: "north →" }];
    this.labels = [...fixed, ...flights.map((flight, index) =>
      ({ index, text: flights.length > 1 ? flight.name : "" }))].slice(0, MOST);
    this.drones = this.labels.length - fixed.length;
    this.scale = Math.min(window.devicePixelRatio || 1, 2);
    this.canvas = document.createElement("canvas");
    this.canvas.width = Math.ceil(this.labels.length / ROWS) * WIDTH * this.scale;
    this.canvas.height = Math.min(this.labels.length, ROWS) * HEIGHT * this.scale;
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    this.texture.generateMipmaps = false;
    this.texture.minFilter = this.texture.magFilter;
    this.resolution = new Vector2(1, 1);
    this.mesh = new Mesh(this.geometry(), new ShaderMaterial({ vertexShader: VERTEX,
      fragmentShader: FRAGMENT, transparent: true, depthTest: false, depthWrite: false, side: 2,
      uniforms: { texts: { value: this.texture }, resolution: { value: this.resolution } } }));
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = 9;
    scene.add(this.mesh);
  }

  geometry() {
    const geometry = new InstancedBufferGeometry();
    const corners = new Float32Array([0, 0, 0, 0, 1, 0, 1, 0, 0, 1, 1, 0]);
    geometry.setAttribute("position", new BufferAttribute(corners, 3));
    geometry.setIndex([0, 1, 2, 1, 3, 2]);
    const count = this.labels.length;
    for (const [name, size] of [["place", 2], ["size", 2], ["cell", 4]]) {
      const values = new InstancedBufferAttribute(new Float32Array(size * count), size);
      geometry.setAttribute(name, values.setUsage(DynamicDrawUsage));
    }
    return geometry;
  }

  setTheme(theme) {
    this.theme = theme;
    const context = this.canvas.getContext("2d");
    context.setTransform(this.scale, 0, 0, this.scale, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.textBaseline = "middle";
    context.lineWidth = 3;
    context.lineJoin = "round";
    this.labels.forEach((label, i) => this.write(context, label, i));
    this.texture.needsUpdate = true;
  }

  // A text with an outline in the color of the background, behind a dot if it is a drone's.
  write(context, label, i) {
    const { ink, background } = SCENE[this.theme];
    const drone = label.index !== undefined;
    [label.x, label.y] = [Math.floor(i / ROWS) * WIDTH, (i % ROWS) * HEIGHT];
    const [x, middle] = [label.x + (drone ? DOT : 2), label.y + HEIGHT / 2];
    context.font = `${label.index === this.selected || !drone ? 700 : 400} 12px system-ui, sans-serif`;
    context.fillStyle = drone ? flightColor(label.index, this.theme) : ink;
    context.strokeStyle = background;
    const text = shortened(context, label.text, WIDTH - DOT - 4);
    label.width = x - label.x + context.measureText(text).width + 3;
    context.strokeText(text, x, middle);
    context.fillText(text, x, middle);
    if (!drone) return;
    context.beginPath();
    context.arc(label.x + DOT / 2, middle, 4, 0, 2 * Math.PI);
    context.stroke();
    context.fill();
  }

  select(index) {
    this.selected = index;
    if (this.theme) this.setTheme(this.theme);
  }

  update({ camera, view }, width, height, places) {
    this.mesh.visible = this.shown;
    if (!this.shown) return;
    this.resolution.set(width, height);
    this.size = [width, height];
    const taken = [];
    const fixed = this.labels.length - this.drones;
    for (let i = 0; i < fixed; i++) {
      const { above, beside } = this.labels[i];
      const position = view === "top" ? beside : above;
      this.put(i, position && this.project(position, camera));
    }
    const first = fixed + this.selected;
    if (first < this.labels.length) {
      this.putDrone(first, view === "on-board" ? null : places[this.selected], camera, taken);
    }
    for (let i = fixed; i < this.labels.length; i++) {
      if (i !== first) this.putDrone(i, places[i - fixed], camera, taken);
    }
    const { place, size, cell } = this.mesh.geometry.attributes;
    for (const values of [place, size, cell]) values.needsUpdate = true;
  }

  // Where another name is near, only the dot is shown.
  putDrone(i, position, camera, taken) {
    const at = position && this.project(position, camera);
    const crowded = at && taken.some(([x, y]) =>
      Math.abs(x - at[0]) < CLEAR[0] && Math.abs(y - at[1]) < CLEAR[1]);
    if (at && !crowded) taken.push(at);
    this.put(i, at, crowded ? DOT : this.labels[i].width, -DOT / 2, -28);
  }

  // The place of a point of the world on the screen, or null outside.
  project(position, camera) {
    const point = this.point.copy(position).project(camera);
    if (point.z >= 1 || Math.abs(point.x) > 1.05 || Math.abs(point.y) > 1.05) return null;
    return [((point.x + 1) / 2) * this.size[0], ((1 - point.y) / 2) * this.size[1]];
  }

  put(i, at, width = this.labels[i].width, right = -width / 2, down = -HEIGHT / 2) {
    const { place, size, cell } = this.mesh.geometry.attributes;
    size.setXY(i, at ? width : 0, at ? HEIGHT : 0);
    if (!at) return;
    const x0 = Math.min(at[0] + right, this.size[0] - width - 4);
    place.setXY(i, Math.round(x0), Math.round(at[1] + down));
    const [across, along] = [this.canvas.width / this.scale, this.canvas.height / this.scale];
    const { x, y } = this.labels[i];
    cell.setXYZW(i, x / across, 1 - y / along, width / across, HEIGHT / along);
  }
}
