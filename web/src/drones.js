// Drones to scale with spinning rotors, and their shadows: one instanced mesh for each part.
import {
  BoxGeometry, CircleGeometry, Color, DynamicDrawUsage, Float32BufferAttribute, InstancedMesh,
  Matrix4, MeshBasicMaterial, MeshLambertMaterial, PlaneGeometry, Quaternion, Vector3,
} from "three";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";

const FRONT_LEFT_FIRST = [[1, -1], [1, 1], [-1, 1], [-1, -1]]; // forward, right
const DOWN = new Vector3(0, -1, 0);

function painted(geometry, shade) {
  const count = geometry.attributes.position.count;
  geometry.setAttribute("color", new Float32BufferAttribute(new Array(3 * count).fill(shade), 3));
  return geometry;
}

// Body axes: x forward, y up, z right. Shades multiply the flight's color.
function bodyGeometry(arm) {
  const parts = [
    painted(new BoxGeometry(0.9 * arm, 0.3 * arm, 0.5 * arm).translate(0, 0.02 * arm, 0), 1),
    painted(new BoxGeometry(0.22 * arm, 0.2 * arm, 0.32 * arm).translate(0.52 * arm, 0, 0), 2.2),
  ];
  for (const angle of [Math.PI / 4, -Math.PI / 4]) {
    parts.push(painted(new BoxGeometry(2 * arm, 0.09 * arm, 0.14 * arm).rotateY(angle), 0.55));
  }
  for (const [forward, right] of FRONT_LEFT_FIRST) {
    const hub = new BoxGeometry(0.2 * arm, 0.25 * arm, 0.2 * arm);
    parts.push(painted(hub.translate(forward * arm * Math.SQRT1_2, 0.08 * arm,
      right * arm * Math.SQRT1_2), forward > 0 ? 1.3 : 0.55));
  }
  return mergeGeometries(parts);
}

function bladeGeometry(rotor) {
  const [long, wide] = [2 * rotor, 0.16 * rotor];
  return mergeGeometries([[long, wide], [wide, long]].map((size) =>
    new PlaneGeometry(...size).rotateX(-Math.PI / 2)));
}

function instanced(scene, geometry, material, count) {
  const mesh = new InstancedMesh(geometry, material, count);
  mesh.instanceMatrix.setUsage(DynamicDrawUsage);
  mesh.frustumCulled = false;
  scene.add(mesh);
  return mesh;
}

export class Drones {
  // Of the drones in the scene, along each axis.
  get size() {
    return this.scratch.scale.setScalar(this.magnification);
  }

  constructor(scene, flights, { arm, rotor }) {
    this.flights = flights;
    this.hubs = FRONT_LEFT_FIRST.map(([forward, right]) => new Vector3(
      forward * arm * Math.SQRT1_2, 0.22 * arm, right * arm * Math.SQRT1_2));
    const glass = { transparent: true, depthWrite: false, forceSinglePass: true };
    const count = flights.length;
    this.bodies = instanced(scene, bodyGeometry(arm),
      new MeshLambertMaterial({ vertexColors: true }), count);
    this.blades = instanced(scene, bladeGeometry(rotor), new MeshBasicMaterial({ side: 2 }), 4 * count);
    this.discs = instanced(scene, new CircleGeometry(rotor, 12).rotateX(-Math.PI / 2),
      new MeshBasicMaterial({ ...glass, opacity: 0.28, side: 2 }), 4 * count);
    this.shadows = instanced(scene, new CircleGeometry(1.5 * arm, 12).rotateX(-Math.PI / 2),
      new MeshBasicMaterial({ ...glass, opacity: 0.45, fog: false }), count);
    this.magnification = 1;
    this.hidden = -1; // the flight whose camera looks out of it
    this.places = flights.map(() => new Vector3());
    this.turns = flights.map(() => new Quaternion());
    this.scratch = { other: new Quaternion(), matrix: new Matrix4(), own: new Matrix4(),
      turn: new Quaternion(), scale: new Vector3() };
  }

  setColors(colors, shadow) {
    colors.forEach((color, i) => {
      this.bodies.setColorAt(i, new Color(color));
      for (let k = 0; k < 4; k++) {
        this.discs.setColorAt(4 * i + k, new Color(color));
        this.blades.setColorAt(4 * i + k, new Color(color).multiplyScalar(0.75));
      }
    });
    for (const mesh of [this.bodies, this.discs, this.blades]) mesh.instanceColor.needsUpdate = true;
    this.shadows.material.color.set(shadow);
  }

  update(time) {
    this.flights.forEach((flight, i) => {
      flight.vectorAt(flight.position, time, this.places[i]);
      flight.attitudeAt(time, this.turns[i], this.scratch.other);
      this.placeOne(flight, i, time);
    });
    for (const mesh of [this.bodies, this.blades, this.discs, this.shadows]) {
      mesh.instanceMatrix.needsUpdate = true;
    }
  }

  placeOne(flight, i, time) {
    const { matrix, own, turn, scale } = this.scratch;
    const size = i === this.hidden ? 1e-6 : this.magnification;
    own.compose(this.places[i], this.turns[i], scale.setScalar(size));
    this.bodies.setMatrixAt(i, own);
    this.hubs.forEach((hub, k) => {
      const angle = flight.at(flight.phase, 4, k, time) * (k % 2 ? 1 : -1);
      matrix.compose(hub, turn.setFromAxisAngle(DOWN, angle), scale.setScalar(1)).premultiply(own);
      this.blades.setMatrixAt(4 * i + k, matrix);
      this.discs.setMatrixAt(4 * i + k, matrix);
    });
    const place = this.places[i];
    matrix.makeScale(size, 1, size).setPosition(place.x, Math.min(0.01, place.y), place.z);
    this.shadows.setMatrixAt(i, matrix);
  }
}
