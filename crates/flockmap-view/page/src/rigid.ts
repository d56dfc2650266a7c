// Rigid transforms: how one frame lies in another.

export type Vector = [number, number, number];

/** A place and a rotation, a quaternion x, y, z, w of length 1. */
export interface Rigid {
  at: Vector;
  turned: [number, number, number, number];
}

/** From the frame that lies so to the one in which it lies. */
export function apply({ at, turned }: Rigid, point: Vector): Vector {
  const [x, y, z] = rotate(turned, point);
  return [at[0] + x, at[1] + y, at[2] + z];
}

/** The way back. */
export function unapply({ at, turned: [x, y, z, w] }: Rigid, point: Vector): Vector {
  return rotate([-x, -y, -z, w], [point[0] - at[0], point[1] - at[1], point[2] - at[2]]);
}

function rotate([x, y, z, w]: Rigid["turned"], [a, b, c]: Vector): Vector {
  const [u, v, t] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u];
}
