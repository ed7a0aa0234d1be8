// Trials of a sweep: a line of each through one axis for each parameter and the lap time.
import { short } from "./charts.js";
import { speedColor } from "./colors.js";
import { el, sharp, style, theme } from "./dom.js";

const PAD = { x: 60, top: 30, bottom: 24 };

// The place in [0, 1] of the values of one axis: logarithmic over decades, texts in order.
function axis(values) {
  if (values.some((value) => typeof value === "string")) {
    const names = [...new Set(values.map(String))].sort();
    const place = (value) => (names.indexOf(String(value)) + 0.5) / names.length;
    return { place, ends: [names[0], names[names.length - 1]] };
  }
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const scale = low > 0 && high > 20 * low ? Math.log : (value) => value;
  const span = scale(high) - scale(low);
  const place = (value) => (span ? (scale(value) - scale(low)) / span : 0.5);
  return { place, ends: [short(low), short(high)] };
}

export class Parallel {
  constructor() {
    this.canvas = el("canvas", { role: "img", "aria-label": "trials by parameter" });
    this.element = el("figure", { class: "chart parallel" },
      el("figcaption", { text: "Trials: one line each; the best is thick" }), this.canvas);
  }

  draw({ trials, best }) {
    const { context, width, height } = sharp(this.canvas);
    const shown = trials.filter((trial) => trial.value !== null);
    if (!shown.length) return;
    const names = Object.keys(shown[0].params);
    const columns = [...names.map((name) => shown.map((trial) => trial.params[name])),
      shown.map((trial) => trial.value)];
    const axes = columns.map(axis);
    const x = (k) => PAD.x + ((width - 2 * PAD.x) * k) / Math.max(axes.length - 1, 1);
    const y = (place) => height - PAD.bottom - (height - PAD.top - PAD.bottom) * place;
    const order = shown.map((_, i) => i).sort((a, b) => (shown[a].index === best) - (shown[b].index === best));
    const time = axes[axes.length - 1];
    for (const i of order) {
      const own = shown[i].index === best;
      context.strokeStyle = `#${speedColor(1 - time.place(shown[i].value), theme.current).getHexString()}`;
      context.globalAlpha = own ? 1 : 0.6;
      context.lineWidth = own ? 3.5 : 1.2;
      context.setLineDash(shown[i].state === "complete" ? [] : [4, 3]);
      context.beginPath();
      axes.forEach((each, k) => context.lineTo(x(k), y(each.place(columns[k][i]))));
      context.stroke();
    }
    context.globalAlpha = 1;
    context.setLineDash([]);
    this.label(context, axes, [...names, "lap time"], x, y);
  }

  label(context, axes, names, x, y) {
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "center";
    axes.forEach(({ ends }, k) => {
      context.strokeStyle = style("--soft");
      context.lineWidth = 1;
      context.strokeRect(x(k), y(1), 0.01, y(0) - y(1));
      context.fillStyle = style("--ink");
      context.fillText(names[k].split(".").pop(), x(k), 12);
      context.fillStyle = style("--soft");
      context.fillText(ends[1], x(k), y(1) - 5);
      context.fillText(ends[0], x(k), y(0) + 14);
    });
  }
}
