// The path behind each drone as a ribbon of constant width on the screen, colored by speed.
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, Mesh, RGBAFormat, ShaderMaterial,
  SRGBColorSpace, Vector2, Vector3,
} from "three";
import { speedColor } from "./colors.js";

const VERTEX = `
attribute vec3 ahead;
attribute vec3 info; // side, speed, time
uniform float now, span, width, low, high;
uniform vec2 resolution;
uniform vec3 head; // where the drone is
varying float level, age;
void main() {
  vec3 place = info.z > now ? head : position; // the last segment ends at the drone
  vec4 a = projectionMatrix * modelViewMatrix * vec4(place, 1.0);
  vec4 b = projectionMatrix * modelViewMatrix * vec4(place + ahead - position, 1.0);
  vec2 way = (b.xy / max(b.w, 1e-3) - a.xy / max(a.w, 1e-3)) * resolution;
  vec2 across = dot(way, way) > 1e-12 ? normalize(vec2(-way.y, way.x)) : vec2(0.0, 1.0);
  a.xy += info.x * width * across / resolution * max(a.w, 1e-3);
  level = (info.y - low) / max(high - low, 1e-3);
  age = max(now - info.z, 0.0) / span;
  gl_Position = a;
}`;
const FRAGMENT = `
uniform sampler2D colors;
uniform float opacity;
varying float level, age;
void main() {
  gl_FragColor = vec4(texture2D(colors, vec2(clamp(level, 0.005, 0.995), 0.5)).rgb,
    opacity * clamp(1.25 - 1.25 * age, 0.0, 1.0));
}`;

const SPACING = 0.03; // s between points of a ribbon; 30 m/s^2 deviate by 3 mm from a line

// Samples that are points of the ribbon: every stride-th and the last.
function pointsOf({ time, count }) {
  const stride = Math.max(1, Math.round((SPACING * (count - 1)) / (time[count - 1] - time[0])));
  const samples = Array.from({ length: Math.ceil((count - 1) / stride) }, (_, i) => i * stride);
  return { stride, samples: [...samples, count - 1] };
}

function ribbon(flight, samples) {
  const n = samples.length;
  const position = new Float32Array(6 * n);
  const ahead = new Float32Array(6 * n);
  const info = new Float32Array(6 * n);
  const index = new Uint32Array(6 * Math.max(n - 1, 1));
  for (let i = 0; i < n; i++) {
    const sample = samples[i];
    const here = flight.position.subarray(3 * sample, 3 * sample + 3);
    const j = Math.min(sample, flight.count - 2);
    for (let side = 0; side < 2; side++) {
      const row = 3 * (2 * i + side);
      position.set(here, row);
      for (let axis = 0; axis < 3; axis++) {
        const way = flight.position[3 * j + 3 + axis] - flight.position[3 * j + axis];
        ahead[row + axis] = here[axis] + way;
      }
      info.set([2 * side - 1, flight.speed[sample], flight.time[sample]], row);
    }
    if (i < n - 1) {
      const a = 2 * i;
      index.set([a, a + 1, a + 2, a + 1, a + 3, a + 2], 6 * i);
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(position, 3));
  geometry.setAttribute("ahead", new BufferAttribute(ahead, 3));
  geometry.setAttribute("info", new BufferAttribute(info, 3));
  geometry.setIndex(new BufferAttribute(index, 1));
  return geometry;
}

export class Trails {
  constructor(scene, flights, range) {
    this.span = 1.5; // s; Infinity: the whole flight
    this.selected = 0;
    this.colors = new DataTexture(new Uint8Array(4 * 64), 64, 1, RGBAFormat);
    this.colors.colorSpace = SRGBColorSpace;
    this.resolution = new Vector2(1, 1);
    this.meshes = flights.map((flight) => {
      const { samples, stride } = pointsOf(flight);
      const uniforms = {
        now: { value: 0 }, span: { value: 1.5 }, width: { value: 3 }, opacity: { value: 1 },
        head: { value: new Vector3() }, low: { value: range[0] }, high: { value: range[1] },
        resolution: { value: this.resolution }, colors: { value: this.colors },
      };
      const material = new ShaderMaterial({ uniforms, vertexShader: VERTEX,
        fragmentShader: `${FRAGMENT.replace(/}$/, "#include <colorspace_fragment>\n}")}`,
        transparent: true, depthWrite: false, side: 2 });
      const mesh = new Mesh(ribbon(flight, samples), material);
      mesh.frustumCulled = false;
      mesh.renderOrder = 1;
      scene.add(mesh);
      return { mesh, uniforms, flight, stride };
    });
  }

  setTheme(theme) {
    const color = new Color();
    for (let i = 0; i < 64; i++) {
      const text = speedColor(i / 63, theme, color).getHex();
      this.colors.image.data.set([(text >> 16) & 255, (text >> 8) & 255, text & 255, 255], 4 * i);
    }
    this.colors.needsUpdate = true;
  }

  update(time, places) {
    this.meshes.forEach(({ mesh, uniforms, flight, stride }, i) => {
      const point = (when) => Math.floor(flight.index(Math.max(when, 0)) / stride);
      const last = time < flight.end ? point(time) + 1 : Math.ceil((flight.count - 1) / stride);
      const first = Number.isFinite(this.span) ? point(time - this.span) : 0;
      mesh.geometry.setDrawRange(6 * first, 6 * Math.max(last - first, 0));
      mesh.visible = this.span > 0 && last > first;
      uniforms.head.value.copy(places[i]);
      uniforms.now.value = Math.min(time, flight.end);
      uniforms.span.value = Number.isFinite(this.span) ? this.span : 1e9;
      uniforms.width.value = i === this.selected ? 5 : 3;
      uniforms.opacity.value = i === this.selected ? 1 : 0.75;
    });
  }
}
