// The 3D replay: the scene, its overlays and the playback of one set of flights.
import { Box3, Vector3 } from "three";
import { Bar } from "./bar.js";
import { Cameras } from "./cameras.js";
import { Clock } from "./clock.js";
import { SCENE, flightColor } from "./colors.js";
import { el, theme } from "./dom.js";
import { Drones } from "./drones.js";
import { Flight, ranking } from "./flight.js";
import { listen } from "./keyboard.js";
import { Labels } from "./labels.js";
import { Overlay } from "./overlay.js";
import { Panel } from "./panel.js";
import { Sight } from "./sight.js";
import { Stage, readGate } from "./stage.js";
import { Trails } from "./trails.js";

const STEP = 0.02; // s, of the step buttons
const PANEL_EVERY = 100; // ms between updates of the panel
const SLOW = 24; // ms a frame above which fewer pixels are drawn
const NARROW = 900; // px, below which the panel is hidden until it is asked for

function softwareRendering() {
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
  constructor(root, data) {
    this.root = root;
    this.software = softwareRendering();
    if (this.software === null) {
      root.append(el("p", { class: "message",
        text: "This page draws with WebGL 2, which this browser does not offer." }));
      return;
    }
    this.gates = data.gates.map(readGate);
    this.flights = data.flights.map((raw) => new Flight(raw, this.gates));
    const { flights, gates } = this;
    this.clock = new Clock(flights.reduce((end, flight) => Math.max(end, flight.end), 0));
    this.bounds = boundsOf(flights, gates);
    this.range = speedRange(flights);
    this.selected = 0;
    this.frames = { count: 0, milliseconds: 0, ratio: this.pixelRatio(), rate: 0 };
    this.build(data);
    this.stage = new Stage(this.canvas, gates, this.bounds, this.software);
    this.drones = new Drones(this.stage.scene, flights, data.drone);
    this.trails = new Trails(this.stage.scene, flights, this.range);
    this.sight = new Sight(this.stage.scene, this.bounds.radius);
    this.labels = new Labels(this.stage.scene, flights, gates, this.bounds);
    this.cameras = new Cameras(this.canvas, this.bounds);
    this.cameras.controls.addEventListener("change", () => { this.dirty = true; });
    this.cameras.controls.addEventListener("start", () => { this.cameras.touched = true; });
    this.clock.onChange = () => {
      this.dirty = true;
      if (!this.clock.playing) this.bar.update();
    };
    theme.onChange = (name) => this.setTheme(name);
    this.setTheme(theme.current);
    this.select(0);
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    this.resize();
    this.overlay.showLens(this.cameras);
    this.setView("orbit");
    listen(this, STEP);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.clock.play();
    requestAnimationFrame((now) => this.frame(now));
  }

  build(data) {
    const { flights } = this;
    this.canvas = el("canvas", { class: "world", tabindex: 0, "aria-label": "3D view" });
    this.panel = new Panel(flights, data.markers, (index) => this.select(index));
    this.bar = new Bar(this.clock, flights, data.markers, STEP);
    this.overlay = new Overlay(this, data.title);
    this.element = el("div", { class: "viewer" },
      el("div", { class: "stage" }, this.canvas, ...this.overlay.elements),
      this.panel.element, this.bar.element);
    const { clientWidth } = this.root;
    if (clientWidth > 640 && clientWidth < NARROW) this.togglePanel(false);
    this.root.append(this.element);
  }

  showPicture() {
    this.sight.setLens(this.cameras.angles, this.cameras.tilt);
    this.overlay.showPicture(this.cameras);
    this.dirty = true;
  }

  toggleSight() {
    this.sight.shown = !this.sight.shown;
    this.overlay.seen.hidden = !this.sight.shown;
    this.dirty = true;
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
    this.overlay.size.textContent = `drones ×${this.drones.magnification}`;
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
    this.overlay.setView(view);
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
    for (const part of [this.labels, this.panel, this.bar, this.overlay]) part.setTheme(name);
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
    requestAnimationFrame((next) => this.frame(next));
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
}
