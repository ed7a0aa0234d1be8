// Names of drones, numbers of gates and the direction of north over the scene.
import { Vector3 } from "three";
import { flightColor } from "./colors.js";
import { el } from "./dom.js";

const CLEAR = [90, 13]; // px between names; of nearer ones only one is shown

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
  return groups.map((group) => ({ ...group,
    element: el("span", { class: "gate-label", text: group.names.join(", ") }) }));
}

export class Labels {
  constructor(flights, gates, { center, high }) {
    this.shown = true;
    this.point = new Vector3();
    const several = flights.length > 1;
    this.drones = flights.map((flight) => el("span", { class: "drone-label" },
      el("i"), el("span", { text: several ? flight.name : "" })));
    this.gates = gateLabels(gates);
    this.north = { place: new Vector3(Math.ceil(high.x) + 0.8, 0, center.z),
      element: el("span", { class: "gate-label", text: "north" }) };
    this.element = el("div", { class: "labels", "aria-hidden": "true" },
      ...this.gates.map((gate) => gate.element), this.north.element, ...this.drones);
  }

  setTheme(theme) {
    this.drones.forEach((label, i) => {
      label.style.setProperty("--own", flightColor(i, theme));
    });
  }

  update({ camera, view }, width, height, places, selected) {
    this.element.hidden = !this.shown;
    if (!this.shown) return;
    this.size = [width, height];
    for (const { above, beside, element } of this.gates) {
      this.put(element, view === "top" ? beside : above, camera);
    }
    this.put(this.north.element, this.north.place, camera);
    const taken = [];
    const order = this.drones.map((_, i) => i).sort((a, b) => (b === selected) - (a === selected));
    for (const i of order) {
      const label = this.drones[i];
      label.classList.toggle("selected", i === selected);
      if (i === selected && view === "on-board") {
        label.style.visibility = "hidden";
        continue;
      }
      const place = this.put(label, places[i], camera);
      const crowded = place && taken.some(([x, y]) =>
        Math.abs(x - place[0]) < CLEAR[0] && Math.abs(y - place[1]) < CLEAR[1]);
      label.classList.toggle("crowded", Boolean(crowded));
      if (place && !crowded) taken.push(place);
    }
  }

  // Move an element to a point of the world; its place on the screen, or null outside.
  put(element, position, camera) {
    const point = this.point.copy(position).project(camera);
    const visible = point.z < 1 && Math.abs(point.x) < 1.05 && Math.abs(point.y) < 1.05;
    element.style.visibility = visible ? "visible" : "hidden";
    if (!visible) return null;
    const x = ((point.x + 1) / 2) * this.size[0];
    const y = ((1 - point.y) / 2) * this.size[1];
    element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    return [x, y];
  }
}
