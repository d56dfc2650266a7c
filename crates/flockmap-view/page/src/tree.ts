// An octree over the blocks with occupied voxels. A node of level L has 64³ cells of 2^L voxels; those of level 0 have 8³ blocks.

/** Faces of a mesh are 8 bytes each. */
export const FACE_BYTES = 8;
/** There are never more than 23 levels: the index of a block has 26 bits and a sign. */
const LEVELS = 23;
const ROOTS_MAX = 8;

/** What was built of a node. */
export interface Built {
  faces: number;
  /** Value of `Node.changes` when it was built. */
  changes: number;
  /** Milliseconds on the clock of the worker. */
  at: number;
  used: number;
}

export class Node {
  children: (Node | null)[] | null;
  /** Level 0: bit 64·z + 8·y + x for each block with occupied voxels. */
  readonly filled: Uint32Array | null;
  /** Blocks with occupied voxels below. */
  blocks = 0;
  changes = 1;
  newest = 0;
  owner = 0;
  built: Built | null = null;

  constructor(
    public id: number,
    readonly level: number,
    readonly x: number,
    readonly y: number,
    readonly z: number,
    public parent: Node | null,
  ) {
    this.children = level > 0 ? new Array(8).fill(null) : null;
    this.filled = level === 0 ? new Uint32Array(16) : null;
  }

  /** Side in voxels. */
  get side(): number {
    return 64 * 2 ** this.level;
  }

  get stale(): boolean {
    return this.built === null || this.built.changes !== this.changes;
  }
}

export class Tree {
  roots: Node[] = [];
  /** All nodes that have a mesh, by id. */
  readonly meshes = new Map<number, Node>();
  /** Ids of nodes that are gone, whose meshes nobody needs. */
  removed: number[] = [];

  constructor(private nextId = 1) {}

  /** A tree whose ids go on where those of this one end. */
  successor(): Tree {
    return new Tree(this.nextId);
  }

  /** Notes that a block changed: whether it has occupied voxels, when, and whose it is. */
  touch(bx: number, by: number, bz: number, filled: boolean, time: number, owner: number): void {
    const node = this.leaf(bx >> 3, by >> 3, bz >> 3, filled);
    if (!node) return;
    const bit = ((bz & 7) << 6) | ((by & 7) << 3) | (bx & 7);
    const was = (node.filled![bit >> 5]! >>> (bit & 31)) & 1;
    const more = (filled ? 1 : 0) - was;
    if (more !== 0) node.filled![bit >> 5]! ^= 1 << (bit & 31);
    for (let n: Node | null = node; n; n = n.parent) {
      n.blocks += more;
      n.changes++;
      n.newest = Math.max(n.newest, time);
      if (filled) n.owner = owner;
    }
    if (node.blocks === 0) this.prune(node);
  }

  /** What stands beside a block may show or hide faces there. */
  touchBeside(bx: number, by: number, bz: number): void {
    for (let axis = 0; axis < 3; axis++) {
      const at = [bx, by, bz][axis]! & 7;
      if (at !== 0 && at !== 7) continue;
      const step = at === 0 ? -1 : 1;
      const n = this.leaf((bx >> 3) + (axis === 0 ? step : 0), (by >> 3) + (axis === 1 ? step : 0), (bz >> 3) + (axis === 2 ? step : 0), false);
      if (n) n.changes++;
    }
  }

  /** The node of level 0 at a place, made where it is missing and `make` says so. */
  leaf(x: number, y: number, z: number, make: boolean): Node | null {
    let node = this.root(x, y, z, make);
    while (node && node.level > 0) {
      const shift = node.level - 1;
      const octant = ((x >> shift) & 1) | (((y >> shift) & 1) << 1) | (((z >> shift) & 1) << 2);
      let child: Node | null = node.children![octant]!;
      if (!child && make) {
        child = new Node(this.nextId++, shift, x >> shift, y >> shift, z >> shift, node);
        node.children![octant] = child;
      }
      node = child;
    }
    return node;
  }

  /** Takes over the meshes of a tree of the same voxels, so that they are shown until there are new ones. */
  adopt(old: Tree): void {
    for (const [id, was] of old.meshes) {
      const now = this.at(was.level, was.x, was.y, was.z);
      if (!now || now.built) {
        this.removed.push(id);
        continue;
      }
      now.built = { ...was.built!, changes: 0 };
      now.id = id;
      this.meshes.set(id, now);
    }
  }

  at(level: number, x: number, y: number, z: number): Node | null {
    const top = this.roots[0]?.level ?? -1;
    if (level > top) return null;
    let node = this.roots.find((r) => r.x === x >> (top - level) && r.y === y >> (top - level) && r.z === z >> (top - level)) ?? null;
    while (node && node.level > level) {
      const shift = node.level - 1 - level;
      node = node.children![((x >> shift) & 1) | (((y >> shift) & 1) << 1) | (((z >> shift) & 1) << 2)]!;
    }
    return node;
  }

  private root(x: number, y: number, z: number, make: boolean): Node | null {
    for (;;) {
      const level = this.roots[0]?.level ?? 0;
      const found = this.roots.find((r) => r.x === x >> level && r.y === y >> level && r.z === z >> level);
      if (found || !make) return found ?? null;
      if (this.roots.length < ROOTS_MAX) {
        this.roots.push(new Node(this.nextId++, level, x >> level, y >> level, z >> level, null));
      } else if (level < LEVELS) {
        this.rise(level + 1);
      }
    }
  }

  /** Puts the roots under ones that are one level higher. */
  private rise(level: number): void {
    const old = this.roots;
    this.roots = [];
    for (const root of old) {
      const [x, y, z] = [root.x >> 1, root.y >> 1, root.z >> 1];
      let above = this.roots.find((r) => r.x === x && r.y === y && r.z === z);
      if (!above) this.roots.push((above = new Node(this.nextId++, level, x, y, z, null)));
      above.children![(root.x & 1) | ((root.y & 1) << 1) | ((root.z & 1) << 2)] = root;
      root.parent = above;
      above.blocks += root.blocks;
      above.newest = Math.max(above.newest, root.newest);
      above.owner = root.owner;
    }
  }

  private prune(node: Node): void {
    for (let n: Node | null = node; n && n.blocks === 0; n = n.parent) {
      if (n.built) {
        this.meshes.delete(n.id);
        this.removed.push(n.id);
      }
      if (n.parent) n.parent.children![n.parent.children!.indexOf(n)] = null;
      else this.roots.splice(this.roots.indexOf(n), 1);
    }
  }
}
