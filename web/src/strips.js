// Signals of the selected flight over the last seconds, as strips.
import { el, sharp, style } from "./dom.js";

export const WINDOW = 4; // s

function rangeOf(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return high > low ? [low, high] : [low - 1, low + 1];
}

const digits = (span) => (span > 50 ? 0 : span > 5 ? 1 : 2);

export class Strip {
  constructor(title, unit, labels, values, size) {
    Object.assign(this, { labels, values, size, range: rangeOf(values) });
    this.canvas = el("canvas", { "aria-hidden": "true" });
    const single = labels.length === 1;
    this.outputs = labels.map(() => el("output"));
    const keys = labels.map((label, k) => el("span", { class: "key", "data-line": k },
      el("span", { text: label }), this.outputs[k]));
    this.element = el("div", { class: "strip" },
      el("div", { class: "strip-head" }, el("span", { class: "name", text: title }), single ? this.outputs[0] : null,
        el("span", { class: "unit", text: unit })),
      this.canvas, single ? null : el("div", { class: "keys" }, ...keys));
  }

  draw(flight, time) {
    const { context, width, height } = sharp(this.canvas);
    if (!width) return;
    const [low, high] = this.range;
    const now = Math.min(time, flight.end);
    const x = (t) => width * (1 - (now - t) / WINDOW);
    const y = (v) => height - 3 - ((height - 6) * (v - low)) / (high - low);
    context.strokeStyle = style("--line");
    context.lineWidth = 1;
    for (const lap of flight.lapEnds) {
      if (lap <= now && lap > now - WINDOW) {
        context.strokeRect(Math.round(x(lap)) + 0.5, 0, 0.01, height);
      }
    }
    const first = flight.index(Math.max(now - WINDOW, 0));
    const last = flight.index(now);
    const step = Math.max(1, Math.floor((last - first) / width));
    context.lineWidth = this.size > 1 ? 1.2 : 1.6;
    for (let k = 0; k < this.size; k++) {
      context.strokeStyle = style(`--line-${k % 4}`);
      context.beginPath();
      for (let i = first; i <= last; i += step) {
        context.lineTo(x(flight.time[i]), y(this.values[this.size * i + k]));
      }
      context.stroke();
    }
    this.outputs.forEach((output, k) => {
      output.textContent = flight.at(this.values, this.size, k, now).toFixed(digits(high - low));
    });
  }
}

// Strips of all signals that a flight has.
export function stripsOf(flight) {
  const strips = [
    new Strip("speed", "m/s", ["speed"], flight.speed, 1),
    new Strip("g-load", "g", ["load"], flight.load, 1),
  ];
  for (const { name, title, unit, labels } of flight.signals) {
    if (title) strips.push(new Strip(title, unit, labels, flight.values[name], labels.length));
  }
  return strips;
}
