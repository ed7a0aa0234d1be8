// Names of drones, numbers of gates and the direction of north, as sprites of constant size: elements
// of the page would be painted and composited one by one in every frame.
import { CanvasTexture, Sprite, SpriteMaterial, SRGBColorSpace, Vector3 } from "three";
import { SCENE, flightColor } from "./colors.js";

const HEIGHT = 18; // px
const LONGEST = 24; // letters
const CLEAR = [90, 13]; // px between names; of nearer ones only one is shown
const MOST = 500; // labels
const FONT = "12px system-ui, sans-serif";

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

const shortened = (text) => (text.length > LONGEST ? `${text.slice(0, LONGEST - 1)}…` : text);

export class Labels {
  constructor(scene, flights, gates, { center, high }) {
    this.shown = true;
    this.selected = 0;
    const north = new Vector3(Math.ceil(high.x) + 0.8, 0, center.z);
    this.fixed = [...gateLabels(gates), { beside: north, text: "north →" }];
    const names = flights.length > 1 ? flights.slice(0, MOST) : [];
    this.names = names.map(({ name }, index) => ({ index, text: shortened(name) }));
    this.scale = Math.min(window.devicePixelRatio || 1, 2);
    for (const label of [...this.fixed, ...this.names]) {
      label.sprite = new Sprite(new SpriteMaterial({ sizeAttenuation: false, depthTest: false,
        fog: false }));
      label.sprite.center.set(0.5, label.index === undefined ? 0.5 : -0.6);
      label.sprite.renderOrder = 9;
      scene.add(label.sprite);
    }
  }

  setTheme(theme) {
    this.theme = theme;
    for (const label of [...this.fixed, ...this.names]) this.write(label);
  }

  // A text with an outline in the color of the background.
  write(label) {
    const { ink, background } = SCENE[this.theme];
    const drone = label.index !== undefined;
    const canvas = document.createElement("canvas");
    const context = canvas.getContext("2d");
    const font = `${label.index === this.selected || !drone ? 700 : 400} ${FONT}`;
    context.font = font;
    label.width = Math.ceil(context.measureText(label.text).width) + 6;
    [canvas.width, canvas.height] = [label.width * this.scale, HEIGHT * this.scale];
    context.setTransform(this.scale, 0, 0, this.scale, 0, 0);
    Object.assign(context, { font, textBaseline: "middle", lineWidth: 3, lineJoin: "round",
      strokeStyle: background, fillStyle: drone ? flightColor(label.index, this.theme) : ink });
    context.strokeText(label.text, 3, HEIGHT / 2);
    context.fillText(label.text, 3, HEIGHT / 2);
    label.sprite.material.map?.dispose();
    label.sprite.material.map = new CanvasTexture(canvas);
    label.sprite.material.map.colorSpace = SRGBColorSpace;
    label.sprite.material.needsUpdate = true;
  }

  select(index) {
    const changed = [this.names[this.selected], this.names[index]];
    this.selected = index;
    if (this.theme) changed.filter(Boolean).forEach((label) => this.write(label));
  }

  update({ camera, view }, width, height, places) {
    const pixel = (2 * Math.tan((camera.fov * Math.PI) / 360)) / height;
    for (const label of this.fixed) this.put(label, view === "top" ? label.beside : label.above, pixel);
    const [first, ...others] = [this.names[this.selected], ...this.names].filter(Boolean);
    const taken = [];
    for (const label of first ? [first, ...others.filter((label) => label !== first)] : []) {
      const hidden = view === "on-board" && label === first;
      const [x, y] = this.pixels(places[label.index], camera, width, height);
      const crowded = taken.some(([a, b]) => Math.abs(a - x) < CLEAR[0] && Math.abs(b - y) < CLEAR[1]);
      if (!crowded && !hidden) taken.push([x, y]);
      this.put(label, crowded || hidden ? null : places[label.index], pixel);
    }
  }

  pixels(place, camera, width, height) {
    this.point = (this.point || new Vector3()).copy(place).project(camera);
    return [(this.point.x * width) / 2, (this.point.y * height) / 2];
  }

  put({ sprite, width }, place, pixel) {
    sprite.visible = this.shown && Boolean(place);
    if (!place) return;
    sprite.position.copy(place);
    sprite.scale.set(width * pixel, HEIGHT * pixel, 1);
  }
}
