// The outline of a map, for a camera that shall see all of it: blocks that are outermost in some direction. The corners of
// its bounds would be much farther out than any voxel, where the map lies askew.

import type { Blocks } from "./blocks";

const BLOCKS_MAX = 8_192;
const DIRECTIONS = 48;

/** Directions spread evenly over the sphere, on a spiral. */
const directions = Array.from({ length: DIRECTIONS }, (_, i) => {
  const z = 1 - (2 * i + 1) / DIRECTIONS;
  const round = Math.sqrt(1 - z * z);
  const turn = i * Math.PI * (3 - Math.sqrt(5));
  return [round * Math.cos(turn), round * Math.sin(turn), z] as const;
});

/** Middles of blocks with occupied voxels, in voxels, three numbers each. Of many blocks every n-th is looked at. */
export function outline(blocks: Blocks): number[] {
  const stride = Math.ceil(blocks.count / BLOCKS_MAX);
  const most = new Float64Array(DIRECTIONS).fill(-Infinity);
  const places: ([number, number, number] | null)[] = new Array(DIRECTIONS).fill(null);
  let n = 0;
  blocks.each((slot, x, y, z) => {
    if (n++ % stride !== 0 || !blocks.hasOccupied(slot)) return;
    for (let i = 0; i < DIRECTIONS; i++) {
      const [a, b, c] = directions[i]!;
      const far = a * x + b * y + c * z;
      if (far <= most[i]!) continue;
      most[i] = far;
      places[i] = [8 * x + 4, 8 * y + 4, 8 * z + 4];
    }
  });
  return [...new Set(places)].flatMap((place) => place ?? []);
}
