// The faces of a node that can be seen: those between an occupied cell and one that is not, each with the shade of its corners.
//
// A face is two words. First: x, y, z of its cell (6 bits each), direction (3 bits: -x +x -y +y -z +z), robot (8 bits). Second: time of
// the last change (24 bits, tenths of a second, 0: older), shade of its four corners (2 bits each, 3: open).

import type { Blocks } from "./blocks";
import type { Node } from "./tree";

// Rows of 128 bits: a word before x = 0, two for the node, one behind; and a row more on each side of y and z.
const WORDS = 4;
const ROWS = 66;
const LAYER = ROWS * WORDS;
const rows = new Uint32Array(ROWS * LAYER);
const cellTime = new Uint32Array(64 * 64 * 64);
const cellOwner = new Uint8Array(64 * 64 * 64);
const slots = new Int32Array(512);
let faces = new Uint32Array(1 << 16);
let length = 0;

/** Faces in a row of the texture that the graphics card reads them from. */
export const ROW_FACES = 512;

export interface Mesh {
  count: number;
  /** Two words a face, filled up to whole rows. The array is the caller's. */
  words: Uint32Array<ArrayBuffer>;
}

/** The faces of a node. */
export function mesh(blocks: Blocks, node: Node): Mesh {
  rows.fill(0);
  length = 0;
  if (node.level === 0) fillBlocks(blocks, node);
  else fillCells(blocks, node, node.x * 64, node.y * 64, node.z * 64, node.level);
  for (let z = 0; z < 64; z++) for (let y = 0; y < 64; y++) row(blocks, node.level, y, z);
  const words = new Uint32Array(2 * ROW_FACES * Math.ceil(length / (2 * ROW_FACES)));
  words.set(faces.subarray(0, length));
  return { count: length / 2, words };
}

function row(blocks: Blocks, level: number, y: number, z: number): void {
  const from = (z + 1) * LAYER + (y + 1) * WORDS;
  for (let w = 1; w <= 2; w++) {
    const i = from + w;
    const here = rows[i]!;
    if (here === 0) continue;
    const left = (here << 1) | (rows[i - 1]! >>> 31);
    const right = (here >>> 1) | (rows[i + 1]! << 31);
    emit(blocks, level, here & ~left, w, y, z, 0);
    emit(blocks, level, here & ~right, w, y, z, 1);
    emit(blocks, level, here & ~rows[i - WORDS]!, w, y, z, 2);
    emit(blocks, level, here & ~rows[i + WORDS]!, w, y, z, 3);
    emit(blocks, level, here & ~rows[i - LAYER]!, w, y, z, 4);
    emit(blocks, level, here & ~rows[i + LAYER]!, w, y, z, 5);
  }
}

function emit(blocks: Blocks, level: number, mask: number, w: number, y: number, z: number, direction: number): void {
  while (mask !== 0) {
    const low = 31 - Math.clz32(mask & -mask);
    mask &= mask - 1;
    const x = ((w - 1) << 5) | low;
    let time: number;
    let owner: number;
    if (level === 0) {
      const slot = slots[((z >> 3) << 6) | ((y >> 3) << 3) | (x >> 3)]!;
      time = blocks.time(slot);
      owner = blocks.ownerOf(slot, ((z & 7) << 6) | ((y & 7) << 3) | (x & 7));
    } else {
      const cell = (z << 12) | (y << 6) | x;
      time = cellTime[cell]!;
      owner = cellOwner[cell]!;
    }
    if (length + 2 > faces.length) {
      const more = new Uint32Array(2 * faces.length);
      more.set(faces);
      faces = more;
    }
    faces[length++] = x | (y << 6) | (z << 12) | (direction << 18) | (owner << 21);
    faces[length++] = (time & 0xffffff) | (corners(x, y, z, direction) << 24);
  }
}

function solid(x: number, y: number, z: number): number {
  return (rows[(z + 1) * LAYER + (y + 1) * WORDS + 1 + (x >> 5)]! >>> (x & 31)) & 1;
}

/** How open the four corners of a face are: two bits each, in the order of (u, v) = 00, 10, 01, 11 along the other two axes. */
function corners(x: number, y: number, z: number, direction: number): number {
  const out = (direction & 1) === 0 ? -1 : 1;
  let a: number, b: number, c: number, d: number, ac: number, bc: number, ad: number, bd: number;
  if (direction < 2) {
    x += out;
    (a = solid(x, y - 1, z)), (b = solid(x, y + 1, z)), (c = solid(x, y, z - 1)), (d = solid(x, y, z + 1));
    (ac = solid(x, y - 1, z - 1)), (bc = solid(x, y + 1, z - 1)), (ad = solid(x, y - 1, z + 1)), (bd = solid(x, y + 1, z + 1));
  } else if (direction < 4) {
    y += out;
    (a = solid(x - 1, y, z)), (b = solid(x + 1, y, z)), (c = solid(x, y, z - 1)), (d = solid(x, y, z + 1));
    (ac = solid(x - 1, y, z - 1)), (bc = solid(x + 1, y, z - 1)), (ad = solid(x - 1, y, z + 1)), (bd = solid(x + 1, y, z + 1));
  } else {
    z += out;
    (a = solid(x - 1, y, z)), (b = solid(x + 1, y, z)), (c = solid(x, y - 1, z)), (d = solid(x, y + 1, z));
    (ac = solid(x - 1, y - 1, z)), (bc = solid(x + 1, y - 1, z)), (ad = solid(x - 1, y + 1, z)), (bd = solid(x + 1, y + 1, z));
  }
  return open(a, c, ac) | (open(b, c, bc) << 2) | (open(a, d, ad) << 4) | (open(b, d, bd) << 6);
}

function open(side: number, other: number, corner: number): number {
  return side & other ? 0 : 3 - side - other - corner;
}

/** Level 0: the blocks as they are, and those around, so that faces between nodes are right. */
function fillBlocks(blocks: Blocks, node: Node): void {
  for (let z = -1; z <= 8; z++) {
    for (let y = -1; y <= 8; y++) {
      for (let x = -1; x <= 8; x++) {
        const bit = (z << 6) | (y << 3) | x;
        const own = x >= 0 && x < 8 && y >= 0 && y < 8 && z >= 0 && z < 8;
        if (own && ((node.filled![bit >> 5]! >>> (bit & 31)) & 1) === 0) continue;
        const slot = blocks.find(8 * node.x + x, 8 * node.y + y, 8 * node.z + z);
        if (own) slots[bit] = slot;
        if (slot >= 0) fillBlock(blocks, slot, x, y, z);
      }
    }
  }
}

function fillBlock(blocks: Blocks, slot: number, x: number, y: number, z: number): void {
  const page = blocks.page(slot);
  const from = blocks.occupiedFrom(slot);
  const word = 1 + (x >> 2);
  const shift = (x & 3) << 3;
  const [zFrom, zTo] = z < 0 ? [7, 7] : z > 7 ? [0, 0] : [0, 7];
  const [yFrom, yTo] = y < 0 ? [7, 7] : y > 7 ? [0, 0] : [0, 7];
  for (let dz = zFrom; dz <= zTo; dz++) {
    for (let dy = yFrom; dy <= yTo; dy++) {
      const byte = page[from + 8 * dz + dy]!;
      if (byte !== 0) rows[(8 * z + dz + 1) * LAYER + (8 * y + dy + 1) * WORDS + word]! |= byte << shift;
    }
  }
}

function set(x: number, y: number, z: number, time: number, owner: number): void {
  const i = (z + 1) * LAYER + (y + 1) * WORDS + 1 + (x >> 5);
  const bit = 1 << (x & 31);
  const cell = (z << 12) | (y << 6) | x;
  if ((rows[i]! & bit) === 0) {
    rows[i]! |= bit;
    cellTime[cell] = time;
    cellOwner[cell] = owner;
  } else if (time >= cellTime[cell]!) {
    cellTime[cell] = time;
    cellOwner[cell] = owner;
  }
}

/** Cells of 2^level voxels under a node; the cell at the low corner of the mesh is (ox, oy, oz). */
function fillCells(blocks: Blocks, node: Node, ox: number, oy: number, oz: number, level: number): void {
  if (node.level + 6 <= level) {
    const up = level - 6 - node.level;
    set((node.x >> up) - ox, (node.y >> up) - oy, (node.z >> up) - oz, node.newest, node.owner);
    return;
  }
  if (node.children) {
    for (const child of node.children) if (child) fillCells(blocks, child, ox, oy, oz, level);
    return;
  }
  for (let word = 0; word < 16; word++) {
    for (let bits = node.filled![word]!; bits !== 0; bits &= bits - 1) {
      const at = 32 * word + 31 - Math.clz32(bits & -bits);
      const bx = 8 * node.x + (at & 7);
      const by = 8 * node.y + ((at >> 3) & 7);
      const bz = 8 * node.z + (at >> 6);
      const slot = blocks.find(bx, by, bz);
      const time = blocks.time(slot);
      const owner = blocks.owner(slot);
      if (level >= 3) {
        const up = level - 3;
        set((bx >> up) - ox, (by >> up) - oy, (bz >> up) - oz, time, owner);
      } else {
        const side = 8 >> level;
        fillCoarse(blocks, slot, bx * side - ox, by * side - oy, bz * side - oz, level, time, owner);
      }
    }
  }
}

/** A block in cells of 2 or 4 voxels. */
function fillCoarse(blocks: Blocks, slot: number, x: number, y: number, z: number, level: number, time: number, owner: number): void {
  const page = blocks.page(slot);
  const from = blocks.occupiedFrom(slot);
  const step = 1 << level;
  const mask = (1 << step) - 1;
  for (let dz = 0; dz < 8; dz += step) {
    for (let dy = 0; dy < 8; dy += step) {
      let byte = 0;
      for (let a = 0; a < step; a++) for (let b = 0; b < step; b++) byte |= page[from + 8 * (dz + a) + dy + b]!;
      for (let dx = 0; byte !== 0; dx++, byte >>= step) {
        if (byte & mask) set(x + dx, y + (dy >> level), z + (dz >> level), time, owner);
      }
    }
  }
}
