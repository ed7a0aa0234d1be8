// Orbit, chase, on-board and top views of one perspective camera.
import { MathUtils, PerspectiveCamera, Quaternion, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

export const VIEWS = ["orbit", "chase", "on-board", "top"];
const UP = new Vector3(0, 1, 0);
const ASPECT = 4 / 3; // of the on-board camera's picture

export class Cameras {
  constructor(element, bounds) {
    this.camera = new PerspectiveCamera(45, 1, 0.03, 2000);
    this.bounds = bounds;
    this.view = "orbit";
    this.fieldOfView = 100; // deg, horizontal, of the on-board camera
    this.tilt = 45; // deg, upwards from the body's x axis
    this.controls = new OrbitControls(this.camera, element);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.minDistance = 0.4;
    this.controls.maxDistance = 12 * bounds.radius;
    this.scratch = { a: new Vector3(), b: new Vector3(), turn: new Quaternion() };
    this.setView("orbit");
  }

  setView(view) {
    this.view = view;
    this.controls.enabled = view === "orbit" || view === "top";
    this.controls.enableRotate = view === "orbit";
    this.controls.screenSpacePanning = view === "top";
    this.camera.up.copy(UP);
    this.reset();
  }

  // Place the orbit or top camera so that the whole track is visible.
  reset() {
    const { center, low, high, radius } = this.bounds;
    this.setLens(this.view === "top" ? 20 : 40);
    const half = Math.tan(MathUtils.degToRad(this.camera.fov / 2));
    if (this.view === "top") {
      const wide = (high.x - low.x) / 2 + 0.8;
      const deep = (high.z - low.z) / 2 + 0.8;
      const distance = Math.max(deep, wide / this.camera.aspect) / half + high.y;
      this.controls.target.set(center.x, 0, center.z);
      this.camera.position.set(center.x, distance, center.z + 1e-3);
    } else {
      this.controls.target.set(center.x, 0.6 * center.y, center.z);
      this.fit(new Vector3(-0.34, 0.52, 0.78).normalize(), radius / half);
    }
    this.controls.update();
  }

  // The distance along a direction from the target at which the corners of the track fill the view.
  fit(direction, distance) {
    const { low, high } = this.bounds;
    for (let round = 0; round < 8; round++) {
      this.camera.position.copy(this.controls.target).addScaledVector(direction, distance);
      this.camera.lookAt(this.controls.target);
      this.camera.updateMatrixWorld();
      let reach = 0;
      for (const x of [low.x, high.x]) for (const y of [0, high.y]) for (const z of [low.z, high.z]) {
        const corner = this.scratch.a.set(x, y, z).project(this.camera);
        reach = Math.max(reach, Math.abs(corner.x) / 0.94, Math.abs(corner.y) / 0.86);
      }
      distance *= 0.5 + 0.5 * reach;
    }
  }

  // Horizontal and vertical field of view of the on-board camera, deg.
  get angles() {
    const half = Math.tan(MathUtils.degToRad(this.fieldOfView / 2)) / ASPECT;
    return [this.fieldOfView, MathUtils.radToDeg(2 * Math.atan(half))];
  }

  // The part of the view that the on-board camera's picture fills, (width, height).
  get picture() {
    const { aspect } = this.camera;
    return aspect > ASPECT ? [ASPECT / aspect, 1] : [1, aspect / ASPECT];
  }

  setLens(degrees) {
    this.camera.fov = degrees;
    this.camera.updateProjectionMatrix();
  }

  resize(width, height) {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.controls.enabled && !this.touched) this.reset();
  }

  // Follow a flight at a time; nothing to do in orbit and top view.
  update(flight, time) {
    if (this.view === "chase") this.chase(flight, time);
    if (this.view === "on-board") this.onBoard(flight, time);
  }

  chase(flight, time) {
    const { a, b } = this.scratch;
    this.setLens(60);
    flight.vectorAt(flight.position, time, a);
    b.set(0, 0, 0);
    for (const offset of [-0.45, -0.3, -0.15, 0, 0.15]) {
      const v = flight.vectorAt(flight.velocity, Math.max(time + offset, 0), new Vector3());
      b.add(v.setY(0.25 * v.y));
    }
    if (b.length() < 0.5) b.set(1, 0, 0).applyQuaternion(flight.attitudeAt(time,
      this.scratch.turn, new Quaternion())).setY(0);
    b.normalize();
    this.camera.up.copy(UP);
    this.camera.position.copy(a).addScaledVector(b, -1.7).addScaledVector(UP, 0.55);
    this.camera.position.y = Math.max(this.camera.position.y, 0.15);
    this.camera.lookAt(a.addScaledVector(b, 0.8));
  }

  onBoard(flight, time) {
    const { a, b, turn } = this.scratch;
    const half = Math.tan(MathUtils.degToRad(this.angles[1] / 2)) / this.picture[1];
    this.setLens(MathUtils.radToDeg(2 * Math.atan(half)));
    flight.attitudeAt(time, turn, new Quaternion());
    const tilt = MathUtils.degToRad(this.tilt);
    b.set(Math.cos(tilt), Math.sin(tilt), 0).applyQuaternion(turn);
    this.camera.up.set(-Math.sin(tilt), Math.cos(tilt), 0).applyQuaternion(turn);
    flight.vectorAt(flight.position, time, this.camera.position);
    this.camera.lookAt(a.copy(this.camera.position).add(b));
  }
}
