// The 3D replay: the scene, its overlays and the playback of one set of flights.
import { Box3, Vector3 } from "three";
import { Bar } from "./bar.js";
import { Cameras, VIEWS } from "./cameras.js";
import { Clock } from "./clock.js";
import { SCENE, flightColor, speedGradient } from "./colors.js";
import { el, theme } from "./dom.js";
import { Drones } from "./drones.js";
import { Flight, ranking } from "./flight.js";
import { listen } from "./keyboard.js";
import { Labels } from "./labels.js";
import { Panel } from "./panel.js";
import { Sight } from "./sight.js";
import { Stage, readGate } from "./stage.js";
import { Trails } from "./trails.js";

const STEP = 0.02; // s, of the step buttons
const PANEL_EVERY = 100; // ms between updates of the panel
const SLOW = 24; // ms a frame above which fewer pixels are drawn
const NARROW = 900; // px, below which the panel is hidden until it is asked for
const TRAILS = { "1.5 s": 1.5, "5 s": 5, "whole flight": Infinity, none: 0 };

export function softwareRendering() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return null;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

function boundsOf(flights, gates) {
  const box = new Box3();
  const point = new Vector3();
  for (const { position } of flights) {
    for (let i = 0; i < position.length; i += 3) box.expandByPoint(point.fromArray(position, i));
  }
  for (const gate of gates) {
    box.expandByPoint(point.fromArray(gate.center).addScalar(0.5 * Math.max(...gate.size)));
    box.expandByPoint(point.fromArray(gate.center).addScalar(-0.5 * Math.max(...gate.size)));
  }
  box.expandByPoint(point.copy(box.min).setY(0));
  const center = box.getCenter(new Vector3());
  return { low: box.min, high: box.max, center,
    radius: Math.max(box.getSize(new Vector3()).length() / 2, 1) };
}

// From a low quantile to the largest speed: the take-off may be slower.
function speedRange(flights) {
  const speeds = flights.flatMap((flight) => [...flight.speed].filter((_, i) => i % 5 === 0)).sort(
    (a, b) => a - b);
  const high = speeds.reduce((a, b) => Math.max(a, b), 0.1);
  return [Math.min(speeds[Math.floor(0.04 * speeds.length)] || 0, high - 0.1), high];
}

export class Viewer {
  constructor(root, data, options = {}) {
    this.root = root;
    this.software = softwareRendering();
    if (this.software === null) {
      root.append(el("p", { class: "message",
        text: "This page draws with WebGL 2, which this browser does not offer." }));
      return;
    }
    this.gates = data.gates.map(readGate);
    this.flights = data.flights.map((raw) => new Flight(raw, this.gates));
    const { flights } = this;
    this.markers = data.markers || [];
    this.clock = new Clock(flights.reduce((end, flight) => Math.max(end, flight.end), 0));
    this.bounds = boundsOf(flights, this.gates);
    this.range = speedRange(flights);
    this.selected = 0;
    this.frames = { count: 0, milliseconds: 0, ratio: this.pixelRatio(), rate: 0 };
    this.build(data);
    const size = data.drone || { arm: 0.12, rotor: 0.07 };
    this.stage = new Stage(this.canvas, this.gates, this.bounds, this.software);
    this.drones = new Drones(this.stage.scene, flights, size);
    this.trails = new Trails(this.stage.scene, flights, this.range);
    this.sight = new Sight(this.stage.scene, this.bounds.radius);
    this.labels = new Labels(this.stage.scene, flights, this.gates, this.bounds);
    this.cameras = new Cameras(this.canvas, this.bounds);
    this.cameras.controls.addEventListener("change", () => { this.dirty = true; });
    this.cameras.controls.addEventListener("start", () => { this.cameras.touched = true; });
    this.start(options);
  }

  start(options) {
    this.clock.onChange(() => {
      this.dirty = true;
      if (!this.clock.playing) this.bar.update();
    });
    this.onTheme = (name) => this.setTheme(name);
    theme.listeners.push(this.onTheme);
    this.setTheme(theme.current);
    this.select(0);
    this.resizer = new ResizeObserver(() => this.resize());
    this.resizer.observe(this.canvas.parentElement);
    this.resize();
    this.setView(options.view || "orbit");
    this.unlisten = listen(this, STEP);
    if (options.play && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.clock.play();
    this.animation = requestAnimationFrame((now) => this.frame(now));
  }

  build(data) {
    const { flights } = this;
    this.canvas = el("canvas", { class: "world", tabindex: 0, "aria-label": "3D view" });
    this.panel = new Panel(flights, this.markers, (index) => this.select(index));
    this.bar = new Bar(this.clock, flights, this.markers, STEP);
    this.element = el("div", { class: "viewer" },
      el("div", { class: "stage" }, this.canvas, this.picture(), this.head(data),
        this.buttons(), this.legend(), this.lens(), this.help()),
      this.panel.element, this.bar.element);
    const { clientWidth } = this.root;
    if (clientWidth > 640 && clientWidth < NARROW) this.togglePanel(false);
    this.root.append(this.element);
  }

  head(data) {
    const laps = this.flights.reduce((most, flight) => Math.max(most, flight.lapEnds.length), 0);
    const count = this.flights.length;
    const what = [count > 1 ? `${count} flights, started together` : "1 flight",
      laps ? `${laps} lap${laps > 1 ? "s" : ""}` : null,
      this.gates.length ? `${this.gates.length} gates` : null].filter(Boolean).join(" · ");
    return el("header", {}, el("h1", { text: data.title }), el("p", { text: what }));
  }

  buttons() {
    this.viewButtons = VIEWS.map((view, i) => el("button", { text: view, title: `${view} (${i + 1})`,
      onclick: () => this.setView(view) }));
    const select = el("select", { "aria-label": "trail", title: "trail",
      onchange: () => this.setTrail(TRAILS[select.value]) },
    ...Object.keys(TRAILS).map((name) => el("option", { value: name, text: `trail: ${name}` })));
    this.sizeButton = el("button", { text: "drones ×1", title: "size of the drones (d)",
      onclick: () => this.magnify() });
    const panelButton = el("button", { text: "data", title: "show or hide the numbers and curves (p)",
      onclick: () => this.togglePanel() });
    return el("nav", {}, el("div", { class: "group" }, ...this.viewButtons),
      el("div", { class: "group" }, select, this.sizeButton, panelButton,
        el("button", { text: "◐", title: "light or dark (t)", "aria-label": "light or dark",
          onclick: () => theme.toggle() }),
        el("button", { text: "help", title: "keys and mouse (h)", onclick: () => this.toggleHelp() })));
  }

  legend() {
    this.gradient = el("div", { class: "gradient" });
    const [low, high] = this.range;
    return el("div", { class: "legend" }, el("span", { text: "speed" }),
      el("span", { text: low.toFixed(0) }), this.gradient, el("span", { text: `${high.toFixed(0)} m/s` }),
      this.gates.length ? el("span", { class: "next", text: "next gate" }) : null,
      el("span", { class: "seen", text: "camera's view", title: "f shows or hides it" }));
  }

  lens() {
    const slider = (name, label, low, high) => {
      const output = el("output");
      const input = el("input", { type: "range", min: low, max: high, step: 1, "aria-label": label,
        oninput: () => { this.cameras[name] = Number(input.value); show(); this.showPicture(); } });
      const show = () => { output.textContent = `${input.value}°`; };
      setTimeout(() => { input.value = this.cameras?.[name]; show(); });
      return el("label", {}, el("span", { text: label }), input, output);
    };
    this.lensBox = el("div", { class: "lens", hidden: "" },
      slider("fieldOfView", "field of view", 40, 150), slider("tilt", "camera tilt", -10, 60));
    return this.lensBox;
  }

  // The edge of the on-board camera's picture; what lies outside it is dimmed.
  picture() {
    this.pictureText = el("span");
    this.pictureBox = el("div", { class: "picture", hidden: "" }, this.pictureText);
    return this.pictureBox;
  }

  showPicture() {
    const { angles, picture, tilt } = this.cameras;
    this.sight.setLens(angles, tilt);
    this.pictureText.textContent =
      `camera picture ${angles.map((angle) => `${angle.toFixed(0)}°`).join(" × ")}`;
    const [x, y] = picture.map((part) => `${50 - 50 * part}%`);
    this.pictureBox.style.inset = `${y} ${x}`;
    this.pictureBox.hidden = this.cameras.view !== "on-board";
    this.dirty = true;
  }

  toggleSight() {
    this.sight.shown = !this.sight.shown;
    this.element.querySelector(".seen").hidden = !this.sight.shown;
    this.dirty = true;
  }

  help() {
    const keys = [["space", "play, pause"], ["← →", "one step (shift: 0.5 s)"],
      ["↑ ↓", "playback speed"], ["1 2 3 4", "orbit, chase, on-board, top"],
      ["n", "next drone"], ["d", "size of the drones"], ["l", "labels"], ["f", "field of view of the camera"],
      ["p", "numbers and curves"],
      ["t", "light, dark"], ["0", "restart"], ["r", "reset the camera"]];
    this.helpBox = el("div", { class: "help", hidden: "" }, el("h2", { text: "Keys" }),
      el("dl", {}, ...keys.flatMap(([key, text]) => [el("dt", { text: key }), el("dd", { text })])),
      el("p", { text: "Drag to turn, right-drag to move, wheel or pinch to zoom." }));
    return this.helpBox;
  }

  toggleHelp() {
    this.helpBox.hidden = !this.helpBox.hidden;
  }

  togglePanel(shown = this.element.classList.contains("no-panel")) {
    this.element.classList.toggle("no-panel", !shown);
  }

  setTrail(span) {
    this.trails.span = span;
    this.dirty = true;
  }

  magnify() {
    this.drones.magnification = { 1: 2, 2: 4, 4: 1 }[this.drones.magnification];
    this.sizeButton.textContent = `drones ×${this.drones.magnification}`;
    this.dirty = true;
  }

  toggleLabels() {
    this.labels.shown = !this.labels.shown;
    this.dirty = true;
  }

  setView(view) {
    this.cameras.touched = false;
    this.cameras.setView(view);
    this.drones.hidden = view === "on-board" ? this.selected : -1;
    this.lensBox.hidden = view !== "on-board";
    this.viewButtons.forEach((button, i) => {
      button.setAttribute("aria-pressed", VIEWS[i] === view);
    });
    this.element.dataset.view = view;
    this.showPicture();
  }

  select(index) {
    this.selected = (index + this.flights.length) % this.flights.length;
    this.trails.selected = this.selected;
    this.labels.select(this.selected);
    this.sight.setColor(flightColor(this.selected, this.theme));
    this.drones.hidden = this.cameras.view === "on-board" ? this.selected : -1;
    this.panel.show(this.selected);
    this.panelDrawn = -Infinity;
    this.dirty = true;
  }

  setTheme(name) {
    this.theme = name;
    this.stage.setTheme(name);
    this.trails.setTheme(name);
    this.sight.setColor(flightColor(this.selected, name));
    this.drones.setColors(this.flights.map((_, i) => flightColor(i, name)), SCENE[name].shadow);
    for (const part of [this.labels, this.panel, this.bar]) part.setTheme(name);
    this.gradient.style.background = speedGradient(name);
    this.panelDrawn = -Infinity;
    this.dirty = true;
  }

  pixelRatio() {
    return Math.min(window.devicePixelRatio || 1, this.software ? 1 : 2);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    [this.width, this.height] = [width, height];
    this.stage.renderer.setPixelRatio(this.frames.ratio);
    this.stage.renderer.setSize(width, height, false);
    this.cameras.resize(width, height);
    this.trails.resolution.set(width, height);
    this.showPicture();
    this.panelDrawn = -Infinity;
  }

  frame(now) {
    this.animation = requestAnimationFrame((next) => this.frame(next));
    const elapsed = this.before === undefined ? 0 : now - this.before;
    this.before = now;
    const moved = this.clock.advance(Math.min(elapsed, 200) / 1000);
    if (moved) this.measure(elapsed);
    if (this.dirty || moved) {
      this.draw();
      this.dirty = false;
      this.stale = true;
      if (moved && !this.software) this.bar.update();
    }
    if (this.stale && now - this.panelDrawn > PANEL_EVERY) {
      this.panelDrawn = now;
      this.panel.update(this.clock.time);
      this.bar.update();
      this.stale = false;
    }
  }

  // Draw fewer pixels where frames take long.
  measure(elapsed) {
    const { frames } = this;
    frames.count += 1;
    frames.milliseconds += elapsed;
    if (frames.count < 40) return;
    const mean = frames.milliseconds / frames.count;
    frames.rate = 1000 / mean;
    frames.count = frames.milliseconds = 0;
    const least = 0.5;
    if (mean > SLOW && frames.ratio > least && !this.software) {
      frames.ratio = Math.max(least, frames.ratio * 0.8);
      this.resize();
    }
  }

  place(time) {
    this.drones.update(time);
    const { places, turns, size } = this.drones;
    this.sight.update(places[this.selected], turns[this.selected], size,
      this.cameras.view !== "on-board");
  }

  draw() {
    const { time } = this.clock;
    const flight = this.flights[this.selected];
    this.place(time);
    this.trails.update(time, this.drones.places);
    this.cameras.update(flight, time);
    const { camera, controls } = this.cameras;
    this.stage.setFog(this.cameras.view === "top" || this.cameras.view === "orbit"
      ? camera.position.distanceTo(controls.target) : this.bounds.radius);
    const passed = flight.passages.findIndex(([at]) => at > time);
    this.stage.highlight(passed < 0 ? -1 : flight.passages[passed][1]);
    this.stage.hideNear(camera, this.cameras.view === "chase" ? 0.9 : 0);
    camera.updateMatrixWorld();
    this.labels.update(this.cameras, this.width, this.height, this.drones.places);
    this.stage.renderer.render(this.stage.scene, camera);
    if (!this.drawn) performance.mark("first-frame");
    this.drawn = true;

  }

  // Numbers of a moment, for tests and scripts: positions and attitudes as drawn.
  state(time = this.clock.time) {
    this.place(time);
    return {
      time, view: this.cameras.view, playing: this.clock.playing, rate: this.clock.rate,
      frameRate: this.frames.rate, pixelRatio: this.frames.ratio,
      triangles: this.stage.renderer.info.render.triangles,
      sight: this.sight.edges.visible, corners: this.sight.corners().map((corner) =>
        ({ place: corner.toArray(), screen: corner.project(this.cameras.camera).toArray() })),
      order: ranking(this.flights, time).map((flight) => flight.name),
      drones: this.flights.map((flight, i) => ({ name: flight.name,
        position: this.drones.places[i].toArray(), attitude: this.drones.turns[i].toArray() })),
    };
  }

  destroy() {
    cancelAnimationFrame(this.animation);
    this.resizer?.disconnect();
    this.unlisten?.();
    theme.listeners = theme.listeners.filter((listener) => listener !== this.onTheme);
    this.cameras?.controls.dispose();
    this.stage?.renderer.dispose();
    this.stage?.renderer.forceContextLoss();
    this.element?.remove();
  }
}
