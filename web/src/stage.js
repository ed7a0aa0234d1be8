// The world: renderer, light, ground, gates.
import {
  AmbientLight, BoxGeometry, Color, CylinderGeometry, DirectionalLight, Fog, GridHelper, Matrix4,
  Mesh, MeshBasicMaterial, MeshLambertMaterial, PlaneGeometry, Scene, TorusGeometry, Vector3,
  WebGLRenderer,
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
    this.width = 2 * Math.ceil(Math.max(high.x - low.x, high.z - low.z) / 2 + 3);
    const plane = new PlaneGeometry(this.width, this.width).rotateX(-Math.PI / 2);
    this.ground = new Mesh(plane, new MeshBasicMaterial({ polygonOffset: true,
      polygonOffsetFactor: 2, polygonOffsetUnits: 2 }));
    this.ground.position.set(Math.round((low.x + high.x) / 2), -0.01, Math.round((low.z + high.z) / 2));
    if (!software) this.scene.add(this.ground);
  }

  // Lines every meter, or every ten meters of a large track.
  drawGrid({ grid, major }) {
    this.grid?.removeFromParent();
    this.grid?.dispose();
    this.grid = new GridHelper(this.width, this.width / (this.width > 300 ? 10 : 1), major, grid);
    this.grid.position.copy(this.ground.position).setY(0.003);
    this.scene.add(this.grid);
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
    this.drawGrid(colors);
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
