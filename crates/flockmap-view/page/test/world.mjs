// A forest that is the same each time: ground, trunks, crowns. Blocks as in the feed.

/** The first random numbers of a seed. */
export function random(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = state;
    t = Math.imul(t ^ (t >>> 15), t | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

export class World {
  /** "x,y,z" of a block: its 128 bytes. */
  blocks = new Map();

  set(x, y, z, state) {
    const key = `${x >> 3},${y >> 3},${z >> 3}`;
    let planes = this.blocks.get(key);
    if (!planes) this.blocks.set(key, (planes = new Uint8Array(128)));
    const at = 8 * (z & 7) + (y & 7);
    const bit = 1 << (x & 7);
    planes[at] &= ~bit;
    planes[64 + at] &= ~bit;
    if (state === 1) planes[at] |= bit;
    if (state === 2) planes[64 + at] |= bit;
    return key;
  }

  get(x, y, z) {
    const planes = this.blocks.get(`${x >> 3},${y >> 3},${z >> 3}`);
    if (!planes) return 0;
    const at = 8 * (z & 7) + (y & 7);
    return (planes[64 + at] >> (x & 7)) & 1 ? 2 : (planes[at] >> (x & 7)) & 1;
  }
}

export function ground(x, y) {
  return Math.round(6 * Math.sin(x / 61) * Math.cos(y / 47) + 3 * Math.sin((x + y) / 23) + 10 * Math.sin(x / 211 + y / 173));
}

/** `side` voxels of ground in a square around zero, and a tree on each so many of them. */
export function forest(side = 400, perTree = 1_400, seed = 7) {
  const world = new World();
  const next = random(seed);
  const half = side >> 1;
  for (let y = -half; y < half; y++) {
    for (let x = -half; x < half; x++) {
      const z = ground(x, y);
      world.set(x, y, z, 2);
      if (Math.abs(z - ground(x + 1, y)) > 1 || next() < 0.12) world.set(x, y, z - 1, 2);
      // Free where something was seen through: a band over the ground, with gaps.
      if (((x >> 5) + (y >> 5)) % 5 !== 0) for (let up = 1; up < 12; up += 1) world.set(x, y, z + up, 1);
      if (next() < 0.004) for (let up = 1; up < 2 + 5 * next(); up++) world.set(x, y, z + up, 2);
    }
  }
  for (let tree = 0; tree < (side * side) / perTree; tree++) {
    const [x, y] = [Math.floor(next() * side) - half, Math.floor(next() * side) - half];
    const z = ground(x, y);
    const tall = 28 + Math.floor(30 * next());
    const thick = 1.2 + 1.4 * next();
    for (let up = 0; up < tall; up++) ring(world, x, y, z + up, thick * (1 - (0.5 * up) / tall));
    const crown = 7 + 5 * next();
    for (let part = 0; part < 260 * (crown / 8) ** 2; part++) {
      const [a, b, r] = [2 * Math.PI * next(), Math.acos(2 * next() - 1), crown * (0.6 + 0.4 * next())];
      const [cx, cy, cz] = [x + r * Math.sin(b) * Math.cos(a), y + r * Math.sin(b) * Math.sin(a), z + tall + 0.8 * r * Math.cos(b)];
      for (let leaf = 0; leaf < 3; leaf++) world.set(Math.round(cx + 2 * next()), Math.round(cy + 2 * next()), Math.round(cz + 2 * next()), 2);
    }
  }
  return world;
}

function ring(world, x, y, z, radius) {
  const reach = Math.ceil(radius);
  for (let dy = -reach; dy <= reach; dy++) {
    for (let dx = -reach; dx <= reach; dx++) {
      const d = Math.hypot(dx, dy);
      if (d <= radius && d > radius - 1.5) world.set(x + dx, y + dy, z, 2);
    }
  }
}

/** Occupied, free. */
export function tally(world) {
  let [occupied, free] = [0, 0];
  const ones = Uint8Array.from({ length: 256 }, (_, b) => b.toString(2).replaceAll("0", "").length);
  for (const planes of world.blocks.values()) {
    for (let i = 0; i < 64; i++) {
      free += ones[planes[i]];
      occupied += ones[planes[64 + i]];
    }
  }
  return { occupied, free, blocks: world.blocks.size };
}
