// The mirror of one map: what the feed says of it, by the rules of docs/map-output.md.

import { Blocks } from "./blocks";
import { Refused } from "./connection";
import { readAnew, readBlocks, readHello, type BlockBytes, type Have, type Hello } from "./feed";
import { Tree } from "./tree";

const NOTHING: Have = { feed: 0n, anew: 0n, upto: 0n };

interface Map3 {
  blocks: Blocks;
  tree: Tree;
  voxel: number;
}

export class Mirror {
  /** What is shown. */
  blocks = new Blocks();
  tree = new Tree();
  /** Side of a voxel in metres; 0 before the first hello. */
  voxel = 0;
  hello: Hello | null = null;
  upto = 0n;
  newest = 0n;
  stamp = 0;
  /** Blocks that are there when the page comes are older than it. */
  complete = false;
  /** Tells that the map that is shown was replaced by one of other voxels. */
  replaced: (() => void) | null = null;

  private has: Have = { ...NOTHING };
  /** The map that began anew, while the one before is still shown. */
  private next: Map3 | null = null;
  /** While paused: the newest states of blocks that changed; those that were emptied are in `emptied`. */
  private held: Blocks | null = null;
  private readonly emptied = new Set<string>();
  private nextWhole = false;

  constructor(
    private readonly clock: () => number,
    private readonly owner: (robot: number) => number,
  ) {}

  have(): Have {
    return this.has;
  }

  /** Forgets what the feed said, not what is shown: for a feed that is asked for other things. */
  restart(): void {
    this.has = { ...NOTHING };
  }

  get renewing(): boolean {
    return this.next !== null;
  }

  frame(kind: number, body: Uint8Array): void {
    if (kind === 1) this.begin(readHello(body));
    else if (kind === 3) this.anew(readAnew(body));
    else if (kind === 2) this.take(body);
  }

  pause(paused: boolean): void {
    if (paused) {
      this.held ??= new Blocks();
      return;
    }
    const held = this.held;
    this.held = null;
    if (!held) return;
    for (const place of this.emptied) {
      const [x, y, z] = place.split(",").map(Number) as [number, number, number];
      this.blocks.removeAt(x, y, z);
      this.changed(this.blocks, this.tree, x, y, z);
    }
    this.emptied.clear();
    held.each((slot, x, y, z) => {
      if (!this.blocks.hasRoom(1) && this.blocks.find(x, y, z) < 0) return;
      this.blocks.copy(held, slot);
      this.changed(this.blocks, this.tree, x, y, z);
    });
    if (this.nextWhole) this.swap();
  }

  private begin(hello: Hello): void {
    this.hello = hello;
    if (hello.feed !== this.has.feed) this.has = { ...NOTHING };
    this.has.feed = hello.feed;
  }

  private anew(version: bigint): void {
    if (!this.hello) throw new Refused("the feed has no hello");
    this.has = { feed: this.hello.feed, anew: version, upto: 0n };
    this.upto = 0n;
    this.nextWhole = false;
    const voxel = this.hello.micrometres / 1e6;
    if (this.blocks.count === 0 && !this.held) {
      // Nothing is shown that would have to stay: the new map may be seen as it comes.
      this.next = { blocks: new Blocks(), tree: this.tree.successor(), voxel };
      this.complete = false;
      this.swap();
      return;
    }
    this.next = { blocks: new Blocks(), tree: this.tree.successor(), voxel };
  }

  private take(body: Uint8Array): void {
    const hello = this.hello;
    if (!hello) throw new Refused("the feed has no hello");
    const to = this.next?.blocks ?? this.held ?? this.blocks;
    const tree = this.next?.tree ?? this.tree;
    const next = this.next !== null;
    const begin = (head: { upto: bigint; newest: bigint; stamp: number; count: number }) => {
      if (!to.hasRoom(head.count) && !this.fits(to, head.count, body)) {
        throw new Refused("The map has more blocks than this page can hold. What is shown is old from now on.");
      }
      this.upto = this.has.upto = head.upto;
      this.newest = head.newest;
      this.stamp = head.stamp;
      return true;
    };
    const now = this.complete ? this.clock() : 0;
    const each = (block: BlockBytes) => {
      const time = next ? this.timeOf(block, now) : now;
      if (to === this.held) this.hold(block, time);
      else if (to.put(block, time, this.owner)) this.changed(to, tree, block.x, block.y, block.z);
    };
    readBlocks(body, begin, each);
    if (this.upto !== this.newest) return;
    if (this.next) {
      this.nextWhole = true;
      if (!this.held) this.swap();
    }
    this.complete = true;
  }

  /** A block of a new map that is as in the one that is shown keeps its age. */
  private timeOf(block: BlockBytes, now: number): number {
    const slot = this.blocks.find(block.x, block.y, block.z);
    if (slot < 0) return now;
    const planes = this.blocks.planes(slot);
    return planes.every((byte, i) => byte === block.planes[i]) ? this.blocks.time(slot) : now;
  }

  /** Counts what is really new: blocks that the map has already need no room. */
  private fits(to: Blocks, count: number, body: Uint8Array): boolean {
    let more = 0;
    if (count * 140 > body.length) return false;
    readBlocks(body, () => true, (block) => {
      if (to.find(block.x, block.y, block.z) < 0) more++;
    });
    return to.hasRoom(more);
  }

  private hold(block: BlockBytes, time: number): void {
    const { x, y, z } = block;
    const place = `${x},${y},${z}`;
    const before = this.held!.find(x, y, z) >= 0;
    this.held!.put(block, time, this.owner);
    if (this.held!.find(x, y, z) >= 0) this.emptied.delete(place);
    else if (before || this.blocks.find(x, y, z) >= 0) this.emptied.add(place);
  }

  private changed(blocks: Blocks, tree: Tree, x: number, y: number, z: number): void {
    const slot = blocks.find(x, y, z);
    const filled = slot >= 0 && blocks.hasOccupied(slot);
    tree.touch(x, y, z, filled, slot >= 0 ? blocks.time(slot) : 0, slot >= 0 ? blocks.owner(slot) : 0);
    tree.touchBeside(x, y, z);
  }

  private swap(): void {
    const { blocks, tree, voxel } = this.next!;
    const same = voxel === this.voxel;
    if (same) tree.adopt(this.tree);
    else tree.removed.push(...this.tree.meshes.keys());
    tree.removed.push(...this.tree.removed);
    this.blocks = blocks;
    this.tree = tree;
    this.voxel = voxel;
    this.next = null;
    this.nextWhole = false;
    this.held = this.held && new Blocks();
    this.emptied.clear();
    if (!same) this.replaced?.();
  }
}
