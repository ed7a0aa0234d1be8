// The live page of a training run or a sweep: asks its server for numbers and flights.
import { Chart, short } from "./charts.js";
import { el, seconds, theme } from "./dom.js";
import { Parallel } from "./parallel.js";
import { Viewer } from "./viewer.js";

const EVERY = 2000; // ms between questions
const CHARTS = [
  ["Time of all laps (s)", ["lap_total", "best_lap_total"]],
  ["Reward per step", ["reward"]],
  ["Crash rate of training episodes", ["crash_rate"]],
  ["Standard deviation of the noise", ["std"]],
  ["Entropy", ["entropy"]],
  ["Gradient norm", ["gradient_norm"]],
  ["Environment steps per second", ["steps_per_second"]],
];

export class Dashboard {
  constructor(root, kind) {
    this.kind = kind;
    this.flights = 0;
    this.charts = CHARTS.map(([title, names]) => new Chart(title, names));
    this.parallel = new Parallel();
    this.heading = el("h1");
    this.status = el("p", { class: "status" });
    this.bar = el("progress", { max: 1, value: 0 });
    this.causes = el("ul", { class: "causes" });
    this.table = el("tbody");
    this.scene = el("div", { class: "scene" },
      el("p", { class: "message", text: "No policy to show yet." }));
    const parts = kind === "sweep" ? this.sweep() : this.training();
    root.append(el("div", { class: "dashboard" },
      el("div", { class: "top" }, this.heading, this.status, this.bar),
      el("div", { class: "curves" }, ...parts), this.scene));
    theme.listeners.push(() => this.draw());
    new ResizeObserver(() => this.draw()).observe(root);
    this.ask();
  }

  training() {
    return [...this.charts.map((chart) => chart.element),
      el("figure", { class: "chart" }, el("figcaption", { text: "Ends of 8 sampled flights" }),
        this.causes)];
  }

  sweep() {
    return [this.parallel.element, el("table", { class: "trials" },
      el("thead", {}, el("tr", {}, ...["trial", "state", "lap time", "parameters"].map((text) =>
        el("th", { text })))), this.table)];
  }

  async ask() {
    try {
      const answer = await fetch("state.json", { cache: "no-store" });
      this.state = await answer.json();
      this.draw();
      if (this.state.flights !== this.flights) await this.fly();
    } catch {
      this.status.textContent = "The server has ended; this is the last state.";
    }
    setTimeout(() => this.ask(), EVERY);
  }

  async fly() {
    const answer = await fetch("flights.json", { cache: "no-store" });
    const record = await answer.json();
    if (!record) return;
    this.flights = this.state.flights;
    const view = this.viewer?.cameras?.view;
    this.viewer?.destroy();
    this.scene.replaceChildren();
    this.viewer = new Viewer(this.scene, record, { play: true, view });
    this.viewer.togglePanel(false);
    window.quadjax.viewer = this.viewer;
  }

  draw() {
    const { state } = this;
    if (!state) return;
    this.heading.textContent = state.name;
    if (this.kind === "sweep") this.drawSweep(state);
    else this.drawTraining(state);
  }

  drawTraining(state) {
    const { columns } = state;
    const last = (name) => columns?.[name]?.[columns[name].length - 1];
    const steps = last("steps") || 0;
    const total = Math.max(state.total_steps || 1, steps);
    this.bar.value = state.finished ? 1 : steps / total;
    const best = last("best_lap_total");
    this.status.textContent = [state.subtitle, columns ? `${short(steps)} of ${short(total)} steps`
      : "compiling", last("seconds") ? `${seconds(last("seconds"), 0)} s` : null,
    best ? `best ${seconds(best)} s for ${state.laps} laps` : "no laps completed yet",
    state.finished ? "finished" : null, state.error || null].filter(Boolean).join(" · ");
    for (const chart of this.charts) {
      chart.element.hidden = !columns || !chart.names.some((name) => columns[name]);
      if (!chart.element.hidden) {
        chart.draw(columns, total, chart.names[0] === "lap_total" ? state.reference : null);
      }
    }
    const causes = Object.entries(state.causes).sort(([, a], [, b]) => b - a);
    this.causes.replaceChildren(...causes.map(([reason, count]) => el("li", {},
      el("span", { text: reason }), el("meter", { max: 8, value: count }), el("b", { text: count }))));
  }

  drawSweep(state) {
    this.bar.hidden = true;
    this.status.textContent = [state.subtitle,
      state.best === null ? null : `best: trial ${state.best}`, state.error || null]
      .filter(Boolean).join(" · ");
    this.parallel.draw(state);
    const rows = [...state.trials].sort((a, b) => (a.value ?? Infinity) - (b.value ?? Infinity));
    this.table.replaceChildren(...rows.map((trial) => el("tr",
      { class: trial.index === state.best ? "selected" : "" },
      ...[trial.index, trial.state, trial.value === null ? "–" : `${seconds(trial.value, 3)} s`,
        Object.entries(trial.params).map(([key, value]) =>
          `${key.split(".").pop()} ${typeof value === "number" ? short(value) : value}`).join(", ")]
        .map((text) => el("td", { text })))));
  }
}
