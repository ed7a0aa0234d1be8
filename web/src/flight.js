// One flight: decoded signals, interpolation in time, progress along the track.
import { quaternionsFromNED, vectorsFromNED } from "./frames.js";

const MISSING = -32768; // of an int16 signal: no value
const GRAVITY = 9.81; // m/s^2

function bytes(text) {
  const raw = atob(text);
  const result = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) result[i] = raw.charCodeAt(i);
  return result.buffer;
}

// int16 columns (n, size), each with its own offset and scale.
function decode(signal) {
  const data = new Int16Array(bytes(signal.data));
  const size = signal.offset.length;
  const values = new Float32Array(data.length);
  for (let i = 0; i < data.length; i++) {
    const column = i % size;
    values[i] = data[i] === MISSING ? NaN : signal.offset[column] + signal.scale[column] * data[i];
  }
  return values;
}

// Index of the first of some rising numbers that is above a value; their count if none is.
function firstAbove(values, value) {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low;
}

export class Flight {
  constructor(raw, gates) {
    this.name = raw.name;
    this.note = raw.note || "";
    this.crash = raw.crash || "";
    this.lapEnds = raw.lap_ends;
    this.passages = raw.passages; // [time, gate, clearance]
    this.time = new Float32Array(bytes(raw.time));
    this.count = this.time.length;
    this.end = this.time[this.count - 1];
    this.signals = raw.signals; // with unit and labels; values are decoded below
    const values = Object.fromEntries(raw.signals.map((signal) => [signal.name, decode(signal)]));
    this.values = values;
    this.position = vectorsFromNED(values.position);
    this.velocity = vectorsFromNED(values.velocity);
    this.attitude = quaternionsFromNED(values.attitude);
    this.speed = this.each((i) => Math.hypot(...this.velocity.subarray(3 * i, 3 * i + 3)));
    this.load = this.each((i) => this.loadAt(i));
    this.phase = this.rotorPhase();
    this.progress = this.progressOn(gates);
    this.last = 0; // index of the latest look-up
  }

  each(f) {
    return Float32Array.from({ length: this.count }, (_, i) => f(i));
  }

  // Specific force over g, from the change of velocity.
  loadAt(i) {
    const a = Math.max(0, i - 1);
    const b = Math.min(this.count - 1, i + 1);
    const dt = Math.max(this.time[b] - this.time[a], 1e-6);
    const rate = (axis) => (this.velocity[3 * b + axis] - this.velocity[3 * a + axis]) / dt;
    return Math.hypot(rate(0), rate(1) + GRAVITY, rate(2)) / GRAVITY;
  }

  // Angles of four rotors, slowed to be visible: 1/40 of the speed, or 3 turns a second.
  rotorPhase() {
    const phase = new Float32Array(4 * this.count);
    const rotors = this.signals.find((signal) => signal.turns_per_second);
    const speeds = rotors ? this.values[rotors.name] : null;
    const perUnit = rotors ? rotors.turns_per_second / 40 : 0;
    for (let i = 1; i < this.count; i++) {
      const dt = this.time[i] - this.time[i - 1];
      for (let k = 0; k < 4; k++) {
        const turns = speeds ? perUnit * speeds[4 * i + k] || 0 : 3;
        phase[4 * i + k] = phase[4 * (i - 1) + k] + 2 * Math.PI * turns * dt;
      }
    }
    return phase;
  }

  // Gates passed, with the fraction of the way from the gate behind to the gate ahead.
  progressOn(gates) {
    if (!gates.length) return new Float32Array(this.count);
    let passed = 0;
    let best = 0;
    return this.each((i) => {
      while (passed < this.passages.length && this.passages[passed][0] <= this.time[i]) passed++;
      const next = passed < this.passages.length ? this.passages[passed][1]
        : passed ? (this.passages[passed - 1][1] + 1) % gates.length : 0;
      const ahead = this.distance(i, gates[next].center);
      const behind = passed ? this.distance(i, gates[this.passages[passed - 1][1]].center)
        : Math.max(this.distance(0, gates[next].center) - ahead, 0);
      best = Math.max(best, passed + Math.min(behind / (behind + ahead + 1e-9), 0.999));
      return best;
    });
  }

  distance(i, point) {
    const p = this.position;
    return Math.hypot(p[3 * i] - point[0], p[3 * i + 1] - point[1], p[3 * i + 2] - point[2]);
  }

  // Index of the last sample at or before a time.
  index(time) {
    const { last, count } = this;
    if (this.time[last] <= time && (last === count - 1 || time < this.time[last + 1])) return last;
    return (this.last = Math.max(firstAbove(this.time, time) - 1, 0));
  }

  // Index and fraction towards the next sample.
  place(time) {
    const i = this.index(time);
    if (i >= this.count - 1) return [this.count - 1, 0];
    const step = this.time[i + 1] - this.time[i];
    return [i, Math.min(Math.max((time - this.time[i]) / step, 0), 1)];
  }

  at(values, size, column, time) {
    const [i, f] = this.place(time);
    const a = values[size * i + column];
    return f === 0 ? a : a + f * (values[size * (i + 1) + column] - a);
  }

  vectorAt(values, time, target) {
    return target.set(
      this.at(values, 3, 0, time), this.at(values, 3, 1, time), this.at(values, 3, 2, time),
    );
  }

  attitudeAt(time, target, other) {
    const [i, f] = this.place(time);
    target.fromArray(this.attitude, 4 * i);
    if (f > 0) target.slerp(other.fromArray(this.attitude, 4 * (i + 1)), f);
    return target.normalize();
  }

  // The time at which the flight had a progress; NaN if it never had.
  timeOf(progress) {
    const p = this.progress;
    if (progress > p[this.count - 1]) return NaN;
    const i = Math.min(firstAbove(p, progress), this.count - 1);
    if (i === 0) return this.time[0];
    const f = Math.min((progress - p[i - 1]) / Math.max(p[i] - p[i - 1], 1e-9), 1);
    return this.time[i - 1] + f * (this.time[i] - this.time[i - 1]);
  }

  lapsAt(time) {
    return this.lapEnds.filter((end) => end <= time).length;
  }
}

// Seconds behind the leader at a time; null where there is none.
export function gapTo(leader, flight, time) {
  const now = Math.min(time, flight.end);
  const there = leader.timeOf(flight.at(flight.progress, 1, 0, now));
  return Number.isFinite(there) ? Math.max(now - there, 0) : null;
}

// Flights in order at a time: who finished first, else who is farther.
export function ranking(flights, time) {
  const rank = (flight) => [
    flight.at(flight.progress, 1, 0, Math.min(time, flight.end)), -Math.min(flight.end, time),
  ];
  return flights.map((flight) => [flight, rank(flight)])
    .sort(([, a], [, b]) => b[0] - a[0] || b[1] - a[1]).map(([flight]) => flight);
}
