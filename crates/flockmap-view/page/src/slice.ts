// A slice through the map at a height, as a picture of bounded size: unknown, free, occupied.

import type { Blocks } from "./blocks";
import type { SliceMessage } from "./protocol";

export const SLICE_SIDE_MAX = 2_048;

/** The slice at voxel z; null where nothing is known there. With more than 2,048 voxels to a side, texels are larger. */
export function slice(blocks: Blocks, z: number): SliceMessage | null {
  const bz = Math.floor(z / 8);
  const layer = z - 8 * bz;
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  const found: number[] = [];
  blocks.each((slot, x, y, at) => {
    if (at !== bz) return;
    found.push(slot);
    [low[0], low[1]] = [Math.min(low[0]!, x), Math.min(low[1]!, y)];
    [high[0], high[1]] = [Math.max(high[0]!, x), Math.max(high[1]!, y)];
  });
  if (found.length === 0) return null;
  let step = 1;
  const side = 8 * (Math.max(high[0]! - low[0]!, high[1]! - low[1]!) + 1);
  while (side / step > SLICE_SIDE_MAX) step *= 2;
  const width = Math.ceil((8 * (high[0]! - low[0]! + 1)) / step);
  const height = Math.ceil((8 * (high[1]! - low[1]! + 1)) / step);
  const texels = new Uint8Array(width * height);
  for (const slot of found) {
    const [x, y] = blocks.place(slot);
    const planes = blocks.planes(slot);
    for (let dy = 0; dy < 8; dy++) {
      const free = planes[8 * layer + dy]!;
      const occupied = planes[64 + 8 * layer + dy]!;
      for (let dx = 0; dx < 8; dx++) {
        const state = (occupied >> dx) & 1 ? 2 : (free >> dx) & 1;
        const u = Math.floor((8 * (x - low[0]!) + dx) / step);
        const v = Math.floor((8 * (y - low[1]!) + dy) / step);
        const i = v * width + u;
        if (state > texels[i]!) texels[i] = state;
      }
    }
  }
  return { kind: "slice", x: 8 * low[0]!, y: 8 * low[1]!, z, step, width, height, texels };
}
