// The bar below the scene: play, step, scrub, rate.
import { RATES } from "./clock.js";
import { flightColor } from "./colors.js";
import { el, seconds } from "./dom.js";

const ICONS = { play: "\u25b6", pause: "\u275a\u275a", back: "\u25c2", ahead: "\u25b8" };

export class Bar {
  constructor(clock, flights, markers, step) {
    this.clock = clock;
    this.button = el("button", { class: "play", onclick: () => clock.play(!clock.playing) });
    this.scrub = el("input", { type: "range", min: 0, max: clock.end, step: 0.001, value: 0,
      "aria-label": "time", oninput: () => clock.seek(Number(this.scrub.value)) });
    this.time = el("output", { class: "time" });
    this.rate = el("select", { "aria-label": "playback speed",
      onchange: () => clock.setRate(Number(this.rate.value)) },
    ...RATES.map((rate) => el("option", { value: rate, text: `${rate}×` })));
    this.ticks = this.lapTicks(flights, markers);
    const button = (name, label, action) =>
      el("button", { title: label, "aria-label": label, text: ICONS[name], onclick: action });
    this.element = el("div", { class: "bar" },
      button("back", "one step back (←)", () => clock.step(-step)), this.button,
      button("ahead", "one step ahead (→)", () => clock.step(step)), this.time,
      el("div", { class: "scrub" }, el("div", { class: "ticks" }, ...this.ticks.map((t) => t.element)),
        this.scrub), this.rate);
    this.update();
  }

  // Ends of laps on the time line: of the flights above it, of the markers below.
  lapTicks(flights, markers) {
    const all = [...flights.slice(0, 8).map((f) => [f.name, f.lapEnds]),
      ...markers.map((m) => [m.name, m.lap_ends])];
    return all.flatMap(([name, ends], index) => ends.map((end, lap) => {
      const marker = index >= Math.min(flights.length, 8);
      const element = el("i", { class: marker ? "marker" : "",
        title: `${name}: lap ${lap + 1} ends at ${seconds(end)} s` });
      element.style.left = `${(100 * end) / this.clock.end}%`;
      return { element, index: marker ? index - 8 + Math.max(flights.length, 8) : index };
    }));
  }

  setTheme(theme) {
    for (const { element, index } of this.ticks) element.style.background = flightColor(index, theme);
  }

  update() {
    const { clock } = this;
    const state = clock.playing ? "pause" : "play";
    if (this.button.dataset.state !== state) {
      this.button.dataset.state = state;
      this.button.textContent = ICONS[state];
      this.button.title = `${state} (space)`;
      this.button.setAttribute("aria-label", state);
    }
    this.scrub.value = clock.time;
    this.time.textContent = `${clock.time.toFixed(2)} / ${clock.end.toFixed(2)} s`;
    this.rate.value = clock.rate;
  }
}
