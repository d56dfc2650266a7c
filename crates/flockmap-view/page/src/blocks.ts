// The blocks of one map: an open-addressed table from the index of a block to a slot, and arrays by slot.

import type { BlockBytes } from "./feed";

export const BLOCKS_MAX = 1 << 20;
/** Blocks of more than one robot for which each voxel's robot is kept; in further ones all voxels are the main robot's. */
export const SHARED_MAX = 1 << 16;
const PAGE = 4_096;
const PAGE_BITS = 12;

const ONES = Uint8Array.from({ length: 256 }, (_, byte) => byte.toString(2).replaceAll("0", "").length);

export function ones(byte: number): number {
  return ONES[byte]!;
}

function hash(x: number, y: number, z: number): number {
  let h = Math.imul(x, 0x9e3779b1) ^ Math.imul(y, 0x85ebca77) ^ Math.imul(z, 0xc2b2ae3d);
  h ^= h >>> 15;
  h = Math.imul(h, 0x2c1b3c6d);
  return (h ^ (h >>> 13)) >>> 0;
}

function grown<T extends Int32Array | Uint32Array | Uint8Array>(old: T, make: new (length: number) => T, length: number): T {
  const fresh = new make(length);
  fresh.set(old as never);
  return fresh;
}

export class Blocks {
  count = 0;
  occupied = 0;
  free = 0;
  /** Occupied voxels by the z of their block, eight counts each: for the range of heights. */
  readonly heights = new Map<number, Int32Array>();

  private table = new Int32Array(1 << 12).fill(-1);
  private mask = (1 << 12) - 1;
  private places = new Int32Array(3 * PAGE);
  private times = new Uint32Array(PAGE);
  private owners = new Uint8Array(PAGE);
  private readonly pages: Uint8Array[] = [];
  /** Robot of each voxel, where a block is of several. */
  private readonly shared = new Map<number, Uint8Array>();
  private readonly unused: number[] = [];
  private slots = 0;

  constructor(private readonly limit = BLOCKS_MAX) {}

  /** The slot of a block, -1 if there is none. */
  find(x: number, y: number, z: number): number {
    const { table, places, mask } = this;
    for (let i = hash(x, y, z) & mask; ; i = (i + 1) & mask) {
      const slot = table[i]!;
      if (slot < 0) return -1;
      const p = 3 * slot;
      if (places[p] === x && places[p + 1] === y && places[p + 2] === z) return slot;
    }
  }

  /** Whether so many further blocks have room. */
  hasRoom(more: number): boolean {
    return this.count + more <= this.limit;
  }

  /**
   * Takes the new state of a block; without known voxels it is removed. `owner` gives the small number, 1 to 255, under
   * which a robot is kept. Says whether anything but the time is different.
   */
  put(block: BlockBytes, time: number, owner: (robot: number) => number): boolean {
    const { x, y, z, planes } = block;
    let known = 0;
    for (let i = 0; i < 128; i++) known |= planes[i]!;
    let slot = this.find(x, y, z);
    if (known === 0) {
      if (slot >= 0) this.remove(slot);
      return slot >= 0;
    }
    let different = false;
    if (slot < 0) {
      slot = this.insert(x, y, z);
      different = true;
    } else {
      this.tally(slot, -1);
    }
    const to = this.planes(slot);
    for (let i = 0; i < 128; i++) {
      if (to[i] !== planes[i]) different = true;
      to[i] = planes[i]!;
    }
    this.tally(slot, 1);
    if (different) this.times[slot] = time;
    return this.putOwners(slot, block, owner) || different;
  }

  /** Takes a block of another map as it is there. */
  copy(from: Blocks, slot: number): void {
    const [x, y, z] = from.place(slot);
    let to = this.find(x, y, z);
    if (to < 0) to = this.insert(x, y, z);
    else this.tally(to, -1);
    this.planes(to).set(from.planes(slot));
    this.tally(to, 1);
    this.times[to] = from.time(slot);
    this.owners[to] = from.owners[slot]!;
    const shared = from.shared.get(slot);
    if (shared && this.shared.size < SHARED_MAX) this.shared.set(to, shared);
    else this.shared.delete(to);
  }

  removeAt(x: number, y: number, z: number): void {
    const slot = this.find(x, y, z);
    if (slot >= 0) this.remove(slot);
  }

  place(slot: number): [number, number, number] {
    return [this.places[3 * slot]!, this.places[3 * slot + 1]!, this.places[3 * slot + 2]!];
  }

  /** 128 bytes, Free then Occupied. */
  planes(slot: number): Uint8Array {
    const from = (slot & (PAGE - 1)) * 128;
    return this.pages[slot >> PAGE_BITS]!.subarray(from, from + 128);
  }

  /** The page of a slot and where its Occupied bytes begin in it: for loops that must not make objects. */
  page(slot: number): Uint8Array {
    return this.pages[slot >> PAGE_BITS]!;
  }

  occupiedFrom(slot: number): number {
    return (slot & (PAGE - 1)) * 128 + 64;
  }

  time(slot: number): number {
    return this.times[slot]!;
  }

  /** The robot that saw most of the block last; 0 if none is known. */
  owner(slot: number): number {
    return this.owners[slot]!;
  }

  ownerOf(slot: number, voxel: number): number {
    const shared = this.shared.get(slot);
    return shared ? shared[voxel]! : this.owners[slot]!;
  }

  hasOccupied(slot: number): boolean {
    const page = this.page(slot);
    const from = this.occupiedFrom(slot);
    for (let i = 0; i < 64; i++) if (page[from + i] !== 0) return true;
    return false;
  }

  each(visit: (slot: number, x: number, y: number, z: number) => void): void {
    const { table, places } = this;
    for (let i = 0; i < table.length; i++) {
      const slot = table[i]!;
      if (slot >= 0) visit(slot, places[3 * slot]!, places[3 * slot + 1]!, places[3 * slot + 2]!);
    }
  }

  /** Bytes of the arrays. */
  bytes(): number {
    const arrays = this.table.byteLength + this.places.byteLength + this.times.byteLength + this.owners.byteLength;
    return arrays + this.pages.length * PAGE * 128 + this.shared.size * 512;
  }

  private putOwners(slot: number, block: BlockBytes, owner: (robot: number) => number): boolean {
    const before = this.owners[slot]!;
    const sharedBefore = this.shared.get(slot);
    this.shared.delete(slot);
    let most = 0;
    let main = 0;
    block.robots.forEach((robot, i) => {
      const share = block.shares[i];
      const voxels = share ? share.reduce((sum, byte) => sum + ones(byte), 0) : 512;
      if (voxels > most) [most, main] = [voxels, owner(robot)];
    });
    this.owners[slot] = main;
    if (block.shares.length === 0 || this.shared.size >= SHARED_MAX) return before !== main || sharedBefore !== undefined;
    const of = sharedBefore ?? new Uint8Array(512);
    of.fill(0);
    block.shares.forEach((share, i) => {
      const number = owner(block.robots[i]!);
      for (let voxel = 0; voxel < 512; voxel++) if ((share[voxel >> 3]! >> (voxel & 7)) & 1) of[voxel] = number;
    });
    this.shared.set(slot, of);
    return true;
  }

  private insert(x: number, y: number, z: number): number {
    if (!this.hasRoom(1)) throw new RangeError("no room for a further block");
    if (2 * (this.count + 1) > this.table.length) this.rehash();
    const slot = this.unused.pop() ?? this.slots++;
    if (slot >> PAGE_BITS >= this.pages.length) this.pages.push(new Uint8Array(PAGE * 128));
    if (slot >= this.times.length) {
      const size = Math.min(2 * this.times.length, this.limit + PAGE);
      this.times = grown(this.times, Uint32Array, size);
      this.owners = grown(this.owners, Uint8Array, size);
      this.places = grown(this.places, Int32Array, 3 * size);
    }
    this.places.set([x, y, z], 3 * slot);
    this.planes(slot).fill(0);
    this.link(slot);
    this.count++;
    return slot;
  }

  private link(slot: number): void {
    const [x, y, z] = this.place(slot);
    let i = hash(x, y, z) & this.mask;
    while (this.table[i]! >= 0) i = (i + 1) & this.mask;
    this.table[i] = slot;
  }

  private rehash(): void {
    const old = this.table;
    this.table = new Int32Array(2 * old.length).fill(-1);
    this.mask = this.table.length - 1;
    for (const slot of old) if (slot >= 0) this.link(slot);
  }

  private remove(slot: number): void {
    this.tally(slot, -1);
    this.shared.delete(slot);
    this.unused.push(slot);
    this.count--;
    const { table, mask } = this;
    let hole = hash(...this.place(slot)) & mask;
    while (table[hole] !== slot) hole = (hole + 1) & mask;
    // What follows moves up, so that no search ends at the hole too soon.
    for (let i = (hole + 1) & mask; table[i]! >= 0; i = (i + 1) & mask) {
      const home = hash(...this.place(table[i]!)) & mask;
      if (((i - home) & mask) >= ((i - hole) & mask)) {
        table[hole] = table[i]!;
        hole = i;
      }
    }
    table[hole] = -1;
  }

  private tally(slot: number, sign: number): void {
    const planes = this.planes(slot);
    const z = this.places[3 * slot + 2]!;
    let row: Int32Array | undefined;
    let free = 0;
    let occupied = 0;
    for (let i = 0; i < 64; i++) {
      free += ONES[planes[i]!]!;
      const here = ONES[planes[64 + i]!]!;
      if (here === 0) continue;
      occupied += here;
      row ??= this.heights.get(z);
      if (!row) this.heights.set(z, (row = new Int32Array(8)));
      row[i >> 3]! += sign * here;
    }
    this.free += sign * free;
    this.occupied += sign * occupied;
  }
}

/** The z, in voxels, below which lie `share` of the occupied voxels; null if there are none. */
export function heightOfShare(blocks: Blocks, share: number): number | null {
  let left = share * blocks.occupied;
  let last: number | null = null;
  for (const z of [...blocks.heights.keys()].sort((a, b) => a - b)) {
    const row = blocks.heights.get(z)!;
    if (row.every((count) => count === 0)) {
      blocks.heights.delete(z);
      continue;
    }
    for (let i = 0; i < 8; i++) {
      if (row[i] === 0) continue;
      last = 8 * z + i;
      left -= row[i]!;
      if (left <= 0) return last;
    }
  }
  return last;
}
