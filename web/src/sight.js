// The pyramid that the on-board camera of a drone sees.
import {
  BufferAttribute, BufferGeometry, DoubleSide, LineBasicMaterial, LineSegments, MathUtils, Mesh,
  MeshBasicMaterial, Vector3,
} from "three";

const EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
const PICTURE = [1, 2, 3, 1, 3, 4];

export class Sight {
  constructor(scene, radius) {
    this.shown = true;
    this.length = Math.max(0.5, 0.03 * radius); // m
    this.points = new BufferAttribute(new Float32Array(15), 3);
    const geometry = (index) => {
      const own = new BufferGeometry();
      own.setAttribute("position", this.points);
      own.setIndex(index);
      return own;
    };
    this.edges = new LineSegments(geometry(EDGES), new LineBasicMaterial());
    this.face = new Mesh(geometry(PICTURE), new MeshBasicMaterial({ transparent: true, opacity: 0.12,
      depthWrite: false, side: DoubleSide, forceSinglePass: true }));
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

  // Corners in body axes, x forward, y up, z right: the picture at a distance of `length`.
  setLens(angles, tilt) {
    const [right, up] = angles.map((angle) => this.length * Math.tan(MathUtils.degToRad(angle / 2)));
    const [c, s] = [Math.cos(MathUtils.degToRad(tilt)), Math.sin(MathUtils.degToRad(tilt))];
    [[1, 1], [1, -1], [-1, -1], [-1, 1]].forEach(([side, top], i) => {
      this.points.setXYZ(i + 1, c * this.length - s * top * up, s * this.length + c * top * up,
        side * right);
    });
    this.points.needsUpdate = true;
  }

  // Corners of the picture in the world.
  corners() {
    return [1, 2, 3, 4].map((i) =>
      new Vector3().fromBufferAttribute(this.points, i).applyMatrix4(this.edges.matrix));
  }

  update(place, turn, scale, visible) {
    for (const part of [this.edges, this.face]) {
      part.visible = this.shown && visible;
      part.matrix.compose(place, turn, scale);
      part.matrixWorldNeedsUpdate = true;
    }
  }
}
