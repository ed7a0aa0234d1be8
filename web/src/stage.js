// The world: renderer, light, ground, gates.
import {
  AmbientLight, BoxGeometry, BufferAttribute, BufferGeometry, Color, CylinderGeometry,
  DirectionalLight, Fog, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial,
  MeshLambertMaterial, PlaneGeometry, Scene, TorusGeometry, Vector3, WebGLRenderer,
} from "three";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";
import { SCENE } from "./colors.js";
import { vectorFromNED } from "./frames.js";

const FRAME = 0.07; // m, width of a gate's frame around its opening
const DEPTH = 0.05; // m, along the passage

// A gate with its center and axes (through, right, down) as vectors of three.js.
export function readGate(raw) {
  const column = (k) => new Vector3(...vectorFromNED(raw.axes[k], raw.axes[3 + k], raw.axes[6 + k]));
  return {
    center: vectorFromNED(...raw.position),
    through: column(0), right: column(1), down: column(2),
    size: raw.size, round: raw.shape === "circle",
  };
}

function box(x, y, z, dx, dy, dz) {
  return new BoxGeometry(dx, dy, dz).translate(x, y, z);
}

// The frame around the opening, in the gate's axes: x through it, y up, z to the right.
function frameGeometry({ size: [width, height], round }) {
  if (round) return new TorusGeometry(width / 2 + FRAME / 2, FRAME / 2, 8, 40).rotateY(Math.PI / 2);
  const [w, h] = [width / 2 + FRAME / 2, height / 2 + FRAME / 2];
  return mergeGeometries([
    box(0, h, 0, DEPTH, FRAME, width + 2 * FRAME), box(0, -h, 0, DEPTH, FRAME, width + 2 * FRAME),
    box(0, 0, w, DEPTH, height, FRAME), box(0, 0, -w, DEPTH, height, FRAME),
  ]);
}

// An arrow below the opening in the direction of passage.
function arrowGeometry({ size: [, height] }) {
  const low = -height / 2 - FRAME / 2;
  return mergeGeometries([
    box(0.14, low, 0, 0.28, 0.02, 0.02),
    new CylinderGeometry(0, 0.05, 0.12, 10).rotateZ(-Math.PI / 2).translate(0.32, low, 0),
  ]);
}

function postGeometry(gate, matrix) {
  const [width, height] = gate.size;
  const sides = gate.round ? [0] : [-width / 2 - FRAME / 2, width / 2 + FRAME / 2];
  const posts = [];
  for (const side of sides) {
    const foot = new Vector3(0, -height / 2 - FRAME, side).applyMatrix4(matrix);
    if (foot.y > 0.05) posts.push(box(foot.x, foot.y / 2, foot.z, 0.03, foot.y, 0.03));
  }
  return posts;
}

export class Stage {
  constructor(canvas, gates, bounds, software) {
    const context = canvas.getContext("webgl2", {
      alpha: false, antialias: !software, stencil: false, powerPreference: "high-performance",
    });
    this.renderer = new WebGLRenderer({ canvas, context });
    this.scene = new Scene();
    this.scene.fog = new Fog("#000", 1, 100);
    this.bounds = bounds;
    this.gates = gates;
    const sun = new DirectionalLight("#fff", 1.7);
    sun.position.set(3, 8, 5);
    this.scene.add(new AmbientLight("#fff", 1.5), sun);
    this.gateMaterial = new MeshLambertMaterial();
    this.nextMaterial = new MeshBasicMaterial();
    this.postMaterial = new MeshLambertMaterial();
    this.addGround(software);
    this.meshes = gates.map((gate) => this.addGate(gate));
  }

  // A software renderer does without the plane, which covers every pixel.
  addGround(software) {
    const { low, high } = this.bounds;
    const [x0, x1] = [Math.floor(low.x - 3), Math.ceil(high.x + 3)];
    const [z0, z1] = [Math.floor(low.z - 3), Math.ceil(high.z + 3)];
    const lines = { minor: [], major: [] };
    const step = Math.max(x1 - x0, z1 - z0) > 300 ? 10 : 1;
    const kind = (value) => (value % (5 * step) === 0 ? lines.major : lines.minor);
    for (let x = x0; x <= x1; x += step) kind(x).push(x, 0, z0, x, 0, z1);
    for (let z = z0; z <= z1; z += step) kind(z).push(x0, 0, z, x1, 0, z);
    this.grid = Object.fromEntries(Object.entries(lines).map(([name, points]) => {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(new Float32Array(points), 3));
      const mesh = new LineSegments(geometry, new LineBasicMaterial());
      mesh.position.y = name === "major" ? 0.004 : 0.002;
      this.scene.add(mesh);
      return [name, mesh];
    }));
    const plane = new PlaneGeometry(x1 - x0, z1 - z0).rotateX(-Math.PI / 2);
    this.ground = new Mesh(plane, new MeshBasicMaterial({ polygonOffset: true,
      polygonOffsetFactor: 2, polygonOffsetUnits: 2 }));
    this.ground.position.set((x0 + x1) / 2, -0.01, (z0 + z1) / 2);
    if (!software) this.scene.add(this.ground);
  }

  addGate(gate) {
    const matrix = new Matrix4().makeBasis(gate.through, gate.down.clone().negate(), gate.right);
    matrix.setPosition(...gate.center);
    const geometry = mergeGeometries(
      [frameGeometry(gate), arrowGeometry(gate)].map((part) => part.applyMatrix4(matrix)));
    const mesh = new Mesh(geometry, this.gateMaterial);
    const posts = postGeometry(gate, matrix);
    if (posts.length) this.scene.add(new Mesh(mergeGeometries(posts), this.postMaterial));
    this.scene.add(mesh);
    return mesh;
  }

  // Hide gates within a distance of the camera, which flies through them.
  hideNear(camera, distance) {
    this.meshes.forEach((mesh, i) => {
      const place = camera.position;
      const [x, y, z] = this.gates[i].center;
      mesh.visible = Math.hypot(place.x - x, place.y - y, place.z - z)
        > Math.max(...this.gates[i].size) * distance;
    });
  }

  highlight(index) {
    if (index === this.highlighted) return;
    this.highlighted = index;
    this.meshes.forEach((mesh, i) => {
      mesh.material = i === index ? this.nextMaterial : this.gateMaterial;
    });
  }

  setTheme(theme) {
    const colors = SCENE[theme];
    this.scene.background = new Color(colors.background);
    this.scene.fog.color.set(colors.background);
    this.ground.material.color.set(colors.ground);
    this.grid.minor.material.color.set(colors.grid);
    this.grid.major.material.color.set(colors.major);
    this.gateMaterial.color.set(colors.gate);
    this.nextMaterial.color.set(colors.next);
    this.postMaterial.color.set(colors.major);
  }

  // The ground fades to the background far beyond the track.
  setFog(distance) {
    this.scene.fog.near = distance + this.bounds.radius;
    this.scene.fog.far = distance + 5 * this.bounds.radius;
  }
}
