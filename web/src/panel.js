// The panel: order of the flights, numbers and strips of the selected one, its laps and gates.
import { flightColor } from "./colors.js";
import { el, seconds } from "./dom.js";
import { gapTo, ranking } from "./flight.js";
import { WINDOW, stripsOf } from "./strips.js";

const GATES_SHOWN = 6;

export class Panel {
  constructor(flights, markers, select) {
    Object.assign(this, { flights, markers, select });
    this.rows = flights.map((flight, index) => this.row(flight, index));
    this.table = el("tbody", {}, ...this.rows.map((row) => row.element));
    this.markerRows = markers.map((marker) => this.markerRow(marker));
    this.numbers = el("div", { class: "numbers" });
    this.stripBox = el("div", { class: "strips" });
    this.laps = el("ol", { class: "laps" });
    this.gates = el("ol", { class: "gates" });
    this.heading = el("h2");
    this.note = el("p", { class: "note" });
    this.element = el("aside", { class: "panel", "aria-label": "Flights and signals" },
      el("section", {},
        el("h2", { text: flights.length > 1 ? "Race" : "Flight" }),
        el("table", {},
          el("thead", {}, el("tr", {}, ...["", "lap", "gap (s)", "m/s"].map((text) =>
            el("th", { text })))),
          this.table, el("tbody", { class: "markers" }, ...this.markerRows.map((r) => r.element)))),
      el("section", {}, this.heading, this.note, this.numbers,
        el("p", { class: "note", text: `Curves: the last ${WINDOW} s` }), this.stripBox),
      el("section", { class: "two" },
        el("div", {}, el("h2", { text: "Lap times" }), this.laps),
        el("div", {}, el("h2", { text: "Distance to gate edge" }), this.gates)));
  }

  row(flight, index) {
    const cells = Object.fromEntries(["lap", "gap", "speed"].map((name) => [name, el("td")]));
    const name = el("td", { class: "who" },
      el("span", { class: "dot" }), el("span", { class: "label", text: flight.name }));
    const element = el("tr", { tabindex: 0, role: "button", title: flight.name,
      onclick: () => this.select(index),
      onkeydown: (event) => { if (event.key === "Enter") this.select(index); } },
    name, ...Object.values(cells));
    return { element, cells, dot: name.firstChild, flight };
  }

  markerRow(marker) {
    const cells = { lap: el("td"), gap: el("td", { class: "wide", colspan: 2 }) };
    const element = el("tr", { title: "lap times only" }, el("td", { class: "who" },
      el("span", { class: "tick" }), el("span", { class: "label", text: marker.name })),
    ...Object.values(cells));
    return { element, cells, marker };
  }

  setTheme(theme) {
    this.rows.forEach((row, i) => { row.dot.style.background = flightColor(i, theme); });
    this.markerRows.forEach((row, i) => {
      row.element.querySelector(".tick").style.borderColor =
        flightColor(this.flights.length + i, theme);
    });
  }

  show(index) {
    this.selected = this.flights[index];
    this.strips = stripsOf(this.selected);
    this.heading.textContent = this.selected.name;
    this.note.textContent = this.selected.note;
    this.stripBox.replaceChildren(...this.strips.map((strip) => strip.element));
    this.rows.forEach((row, i) => row.element.classList.toggle("selected", i === index));
    this.lapsShown = this.gatesShown = -1;
  }

  update(time) {
    const order = ranking(this.flights, time);
    const leader = order[0];
    for (const row of this.rows) this.updateRow(row, leader, time);
    const wanted = order.map((flight) => this.rows[this.flights.indexOf(flight)].element);
    if (wanted.some((element, i) => this.table.children[i] !== element)) {
      this.table.append(...wanted);
    }
    for (const { cells, marker } of this.markerRows) {
      const done = marker.lap_ends.filter((end) => end <= time).length;
      const total = marker.lap_ends.length;
      cells.lap.textContent = done >= total ? "✓" : `${done + 1}/${total}`;
      cells.gap.textContent = done >= total ? `${seconds(marker.lap_ends[total - 1])} s`
        : `next ${seconds(marker.lap_ends[done])} s`;
    }
    this.updateSelected(leader, time);
  }

  updateRow({ element, cells, flight }, leader, time) {
    const laps = flight.lapsAt(time);
    const ended = time >= flight.end;
    const total = flight.lapEnds.length + (flight.crash ? 1 : 0);
    const lost = ended && flight.crash;
    cells.lap.textContent = lost ? "✕" : ended && laps >= total && total ? "✓"
      : total ? `${Math.min(laps + 1, total)}/${total}` : "–";
    const gap = flight === leader ? null : gapTo(leader, flight, time);
    cells.gap.textContent = lost ? flight.crash : ended && laps ? `${seconds(flight.lapEnds[laps - 1])} s`
      : flight === leader ? (this.flights.length > 1 ? "leads" : "") : gap === null ? "–" : `+${seconds(gap)}`;
    cells.speed.textContent = ended ? "" : flight.at(flight.speed, 1, 0, time).toFixed(1);
    element.classList.toggle("ended", ended);
  }

  updateSelected(leader, time) {
    const flight = this.selected;
    const now = Math.min(time, flight.end);
    const laps = flight.lapsAt(now);
    const started = laps ? flight.lapEnds[laps - 1] : 0;
    const gap = flight === leader ? 0 : gapTo(leader, flight, time);
    const height = flight.at(flight.position, 3, 1, now);
    const values = [
      ["time", `${seconds(now)} s`],
      ["this lap", laps < flight.lapEnds.length || !laps ? `${seconds(now - started)} s` : "–"],
      this.flights.length < 2 ? ["laps", String(laps)]
        : ["gap", gap === null ? "–" : gap ? `+${seconds(gap)} s` : "leads"],
      ["speed", `${flight.at(flight.speed, 1, 0, now).toFixed(1)} m/s`],
      ["g-load", `${flight.at(flight.load, 1, 0, now).toFixed(1)} g`],
      ["height", `${height.toFixed(1)} m`],
    ];
    if (!this.numbers.children.length) {
      this.numbers.append(...values.map(([name]) => el("div", {},
        el("span", { class: "what", text: name }), el("b"))));
    }
    values.forEach(([, text], i) => { this.numbers.children[i].lastChild.textContent = text; });
    for (const strip of this.strips) strip.draw(flight, time);
    this.listLaps(flight, laps);
    this.listGates(flight, now);
  }

  listLaps(flight, laps) {
    if (laps === this.lapsShown) return;
    this.lapsShown = laps;
    const times = flight.lapEnds.map((end, i) => end - (i ? flight.lapEnds[i - 1] : 0));
    const best = Math.min(...times.slice(0, laps));
    this.laps.replaceChildren(...times.slice(0, laps).map((lap) => el("li", {
      class: lap === best ? "best" : "", text: `${seconds(lap)} s` })));
    if (!laps) this.laps.append(el("li", { class: "none", text: "no lap yet" }));
  }

  listGates(flight, now) {
    const count = flight.passages.filter(([time]) => time <= now).length;
    if (count === this.gatesShown) return;
    this.gatesShown = count;
    const shown = flight.passages.slice(Math.max(count - GATES_SHOWN, 0), count).reverse();
    this.gates.replaceChildren(...shown.map(([, gate, clearance]) => el("li", {
      class: clearance < 0 ? "hit" : "",
      text: `gate ${gate + 1}: ${clearance === null ? "–" : `${clearance.toFixed(2)} m`}` })));
    if (!count) this.gates.append(el("li", { class: "none", text: "no gate yet" }));
  }
}
