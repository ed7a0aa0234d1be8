// Curves of a training over its steps, on canvases.
import { el, sharp, style } from "./dom.js";

const PAD = { left: 44, right: 18, top: 6, bottom: 18 };

function nice(span) {
  const power = 10 ** Math.floor(Math.log10(span / 3));
  return power * ([1, 2, 5, 10].find((step) => span / (step * power) <= 4) || 10);
}

export function short(value) {
  const size = Math.abs(value);
  if (size >= 1e6) return `${Number((value / 1e6).toPrecision(3))}M`;
  if (size >= 1e3) return `${Number((value / 1e3).toPrecision(3))}k`;
  return String(Number(value.toPrecision(3)));
}

export class Chart {
  constructor(title, names) {
    Object.assign(this, { title, names });
    this.canvas = el("canvas", { role: "img", "aria-label": title });
    this.value = el("output");
    this.element = el("figure", { class: "chart" },
      el("figcaption", {}, el("span", { text: title }), this.value), this.canvas);
  }

  draw(columns, total, reference) {
    const { context, width, height } = sharp(this.canvas);
    const lines = this.names.filter((name) => columns[name]).map((name) => columns[name]);
    const shown = lines.flat().filter((value) => value !== null);
    const last = [...(lines[0] || [])].reverse().find((value) => value !== null);
    this.value.textContent = last === undefined ? "–" : short(last);
    if (!shown.length) {
      context.font = "12px system-ui, sans-serif";
      context.fillStyle = style("--soft");
      context.textAlign = "center";
      context.fillText("no value yet", width / 2, height / 2);
      return;
    }
    let [low, high] = [Math.min(...shown), Math.max(...shown)];
    if (reference) [low, high] = [Math.min(low, reference.value), Math.max(high, reference.value)];
    if (reference) high = Math.min(high, 1.8 * low);
    if (high - low < 1e-12) [low, high] = [low - 0.5, high + 0.5];
    const [x0, y0] = [PAD.left, height - PAD.bottom];
    const x = (step) => x0 + ((width - x0 - PAD.right) * step) / total;
    const y = (value) => y0 - ((y0 - PAD.top) * (value - low)) / (high - low);
    this.axes(context, { x, y, low, high, total, y0, width });
    context.save();
    context.beginPath();
    context.rect(x0, 0, width - x0, y0 + 1);
    context.clip();
    lines.forEach((line, k) => {
      context.strokeStyle = style(`--line-${k}`);
      context.lineWidth = 1.6;
      context.beginPath();
      line.forEach((value, i) => {
        if (value !== null) context.lineTo(x(columns.steps[i]), y(value));
      });
      context.stroke();
      const single = line.filter((value) => value !== null).length === 1;
      const i = line.findIndex((value) => value !== null);
      context.fillStyle = context.strokeStyle;
      if (single) context.fillRect(x(columns.steps[i]) - 3, y(line[i]) - 3, 6, 6);
    });
    if (reference) this.reference(context, y(reference.value), x0, width, reference.label);
    context.restore();
  }

  axes(context, { x, y, low, high, total, y0, width }) {
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = style("--soft");
    context.strokeStyle = style("--line");
    context.lineWidth = 1;
    context.textAlign = "right";
    for (let v = Math.ceil(low / nice(high - low)) * nice(high - low); v <= high; v += nice(high - low)) {
      context.fillText(short(Math.abs(v) < 1e-9 * (high - low) ? 0 : v), PAD.left - 5, y(v) + 4);
      context.beginPath();
      context.moveTo(PAD.left, y(v));
      context.lineTo(width - PAD.right, y(v));
      context.stroke();
    }
    context.textAlign = "center";
    for (let s = 0; s <= total; s += nice(total)) context.fillText(s ? short(s) : "0 steps", x(s) + (s ? 0 : 14), y0 + 14);
  }

  reference(context, y, left, width, label) {
    context.setLineDash([5, 4]);
    context.strokeStyle = style("--soft");
    context.beginPath();
    context.moveTo(left, y);
    context.lineTo(width, y);
    context.stroke();
    context.setLineDash([]);
    context.textAlign = "right";
    context.fillStyle = style("--soft");
    context.fillText(label, width - PAD.right, y - 4);
  }
}
