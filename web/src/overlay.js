// What stands over the scene: title, buttons, legend, the lens of the on-board camera, help.
import { VIEWS } from "./cameras.js";
import { speedGradient } from "./colors.js";
import { el, theme } from "./dom.js";

const TRAILS = { "1.5 s": 1.5, "5 s": 5, "whole flight": Infinity, none: 0 };
const KEYS = [["space", "play, pause"], ["← →", "one step (shift: 0.5 s)"],
  ["↑ ↓", "playback speed"], ["1 2 3 4", "orbit, chase, on-board, top"], ["n", "next drone"],
  ["d", "size of the drones"], ["l", "labels"], ["f", "field of view of the camera"],
  ["p", "numbers and curves"], ["t", "light, dark"], ["0", "restart"], ["r", "reset the camera"]];
const LENS = { fieldOfView: ["field of view", 40, 150], tilt: ["camera tilt", -10, 60] };

function head(title, flights, gates) {
  const laps = flights.reduce((most, flight) => Math.max(most, flight.lapEnds.length), 0);
  const what = [flights.length > 1 ? `${flights.length} flights, started together` : "1 flight",
    laps ? `${laps} lap${laps > 1 ? "s" : ""}` : null,
    gates.length ? `${gates.length} gates` : null].filter(Boolean).join(" · ");
  return el("header", {}, el("h1", { text: title }), el("p", { text: what }));
}

export class Overlay {
  constructor(viewer, title) {
    this.gradient = el("div", { class: "gradient" });
    this.seen = el("span", { class: "seen", text: "camera's view", title: "f shows or hides it" });
    this.size = el("button", { text: "drones ×1", title: "size of the drones (d)",
      onclick: () => viewer.magnify() });
    this.views = VIEWS.map((view, i) => el("button", { text: view, title: `${view} (${i + 1})`,
      onclick: () => viewer.setView(view) }));
    this.sliders = Object.entries(LENS).map(([name, range]) => this.slider(viewer, name, ...range));
    this.lens = el("div", { class: "lens", hidden: "" }, ...this.sliders.map((s) => s.element));
    this.pictureText = el("span");
    // The edge of the on-board camera's picture; what lies outside it is dimmed.
    this.picture = el("div", { class: "picture", hidden: "" }, this.pictureText);
    this.help = el("div", { class: "help", hidden: "" }, el("h2", { text: "Keys" }),
      el("dl", {}, ...KEYS.flatMap(([key, text]) => [el("dt", { text: key }), el("dd", { text })])),
      el("p", { text: "Drag to turn, right-drag to move, wheel or pinch to zoom." }));
    this.elements = [this.picture, head(title, viewer.flights, viewer.gates), this.buttons(viewer),
      this.legend(viewer), this.lens, this.help];
  }

  buttons(viewer) {
    const select = el("select", { "aria-label": "trail", title: "trail",
      onchange: () => viewer.setTrail(TRAILS[select.value]) },
    ...Object.keys(TRAILS).map((name) => el("option", { value: name, text: `trail: ${name}` })));
    return el("nav", {}, el("div", { class: "group" }, ...this.views),
      el("div", { class: "group" }, select, this.size,
        el("button", { text: "data", title: "show or hide the numbers and curves (p)",
          onclick: () => viewer.togglePanel() }),
        el("button", { text: "◐", title: "light or dark (t)", "aria-label": "light or dark",
          onclick: () => theme.toggle() }),
        el("button", { text: "help", title: "keys and mouse (h)", onclick: () => this.toggleHelp() })));
  }

  legend({ range: [low, high], gates }) {
    return el("div", { class: "legend" }, el("span", { text: "speed" }),
      el("span", { text: low.toFixed(0) }), this.gradient,
      el("span", { text: `${high.toFixed(0)} m/s` }),
      gates.length ? el("span", { class: "next", text: "next gate" }) : null, this.seen);
  }

  slider(viewer, name, label, low, high) {
    const output = el("output");
    const show = () => { output.textContent = `${input.value}°`; };
    const input = el("input", { type: "range", min: low, max: high, step: 1, "aria-label": label,
      oninput: () => {
        viewer.cameras[name] = Number(input.value);
        show();
        viewer.showPicture();
      } });
    const set = (value) => { input.value = value; show(); };
    return { name, set, element: el("label", {}, el("span", { text: label }), input, output) };
  }

  showLens(cameras) {
    for (const { name, set } of this.sliders) set(cameras[name]);
  }

  showPicture({ angles, picture }) {
    this.pictureText.textContent =
      `camera picture ${angles.map((angle) => `${angle.toFixed(0)}°`).join(" × ")}`;
    const [x, y] = picture.map((part) => `${50 - 50 * part}%`);
    this.picture.style.inset = `${y} ${x}`;
  }

  setView(view) {
    this.lens.hidden = this.picture.hidden = view !== "on-board";
    this.views.forEach((button, i) => button.setAttribute("aria-pressed", VIEWS[i] === view));
  }

  setTheme(name) {
    this.gradient.style.background = speedGradient(name);
  }

  toggleHelp(hidden = !this.help.hidden) {
    this.help.hidden = hidden;
  }
}
