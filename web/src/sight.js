// The pyramid that the on-board camera of a drone sees.
import {
  ConeGeometry, EdgesGeometry, LineBasicMaterial, LineSegments, MathUtils, Matrix4, Mesh,
  MeshBasicMaterial, Quaternion, Vector3,
} from "three";

const RIGHT = new Vector3(0, 0, 1);

export class Sight {
  constructor(scene, radius) {
    this.shown = true;
    this.length = Math.max(0.5, 0.03 * radius); // m
    // Apex in the drone, base at x = 1 with corners at y, z = 1 and -1.
    const pyramid = new ConeGeometry(Math.SQRT2, 1, 4).rotateY(Math.PI / 4).rotateZ(Math.PI / 2)
      .translate(0.5, 0, 0);
    this.edges = new LineSegments(new EdgesGeometry(pyramid), new LineBasicMaterial());
    this.face = new Mesh(pyramid, new MeshBasicMaterial({ transparent: true, opacity: 0.06,
      depthWrite: false, side: 2, forceSinglePass: true }));
    this.lens = new Matrix4();
    for (const part of [this.edges, this.face]) {
      part.frustumCulled = false;
      part.matrixAutoUpdate = false;
      scene.add(part);
    }
  }

  setColor(color) {
    this.edges.material.color.set(color);
    this.face.material.color.set(color);
  }

  // Body axes: x forward, y up, z right; the picture is at a distance of `length`.
  setLens(angles, tilt) {
    const [right, up] = angles.map((angle) => Math.tan(MathUtils.degToRad(angle / 2)));
    const turn = new Quaternion().setFromAxisAngle(RIGHT, MathUtils.degToRad(tilt));
    this.lens.compose(new Vector3(), turn, new Vector3(1, up, right).multiplyScalar(this.length));
  }

  // Corners of the picture in the world.
  corners() {
    return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([right, up]) =>
      new Vector3(1, up, right).applyMatrix4(this.edges.matrix));
  }

  update(place, turn, scale, visible) {
    for (const part of [this.edges, this.face]) {
      part.visible = this.shown && visible;
      part.matrix.compose(place, turn, scale).multiply(this.lens);
      part.matrixWorldNeedsUpdate = true;
    }
  }
}
