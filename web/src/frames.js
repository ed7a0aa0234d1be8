// World NED (north, east, down) and body FRD to the axes of three.js, with y up: (n, -d, e).
// The map is a rotation, so the vector part of a quaternion is mapped as a vector.

export const vectorFromNED = (north, east, down) => [north, -down, east];

// Body-to-world quaternion (w, x, y, z) in NED and FRD to (x, y, z, w) of three.js.
export const quaternionFromNED = (w, x, y, z) => [x, -z, y, w];

export function vectorsFromNED(values) {
  const result = new Float32Array(values.length);
  for (let i = 0; i < values.length; i += 3) {
    result.set(vectorFromNED(values[i], values[i + 1], values[i + 2]), i);
  }
  return result;
}

export function quaternionsFromNED(values) {
  const result = new Float32Array(values.length);
  for (let i = 0; i < values.length; i += 4) {
    result.set(quaternionFromNED(values[i], values[i + 1], values[i + 2], values[i + 3]), i);
  }
  return result;
}
