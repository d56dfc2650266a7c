// Which nodes are shown: as fine as the camera can see, within what a frame may cost.

import { FACE_BYTES, type Node, type Tree } from "./tree";

/** In voxels of the map. */
export interface Camera {
  eye: [number, number, number];
  /** Planes of the frustum, four numbers each: inside where n·p + d >= 0. */
  planes: number[];
  /** Pixels of a unit length at distance 1. */
  focal: number;
}

export interface Budget {
  /** A cell may be so many pixels large. */
  pixels: number;
  nodes: number;
  faces: number;
}

/** Faces of a node, as built, or guessed from its blocks. */
export function facesOf(node: Node): number {
  if (node.built) return node.built.faces;
  return Math.min(64 * 64 * 12, 90 * Math.ceil(node.blocks / 4 ** Math.min(node.level, 10)));
}

/** Pixels of a cell at the place of the node that is nearest to the eye; less where the camera does not look. */
export function cellPixels(node: Node, camera: Camera): number {
  const side = node.side;
  const low = [node.x * side, node.y * side, node.z * side] as const;
  let squared = 0;
  for (let axis = 0; axis < 3; axis++) {
    const e = camera.eye[axis]!;
    const off = Math.max(low[axis]! - e, 0, e - low[axis]! - side);
    squared += off * off;
  }
  const distance = Math.max(Math.sqrt(squared), 1);
  const pixels = ((side / 64) * camera.focal) / distance;
  return inSight(low, side, camera.planes) ? pixels : pixels / 8;
}

export function inSight(low: readonly [number, number, number], side: number, planes: number[]): boolean {
  for (let i = 0; i < planes.length; i += 4) {
    let most = planes[i + 3]!;
    for (let axis = 0; axis < 3; axis++) {
      const n = planes[i + axis]!;
      most += n * (low[axis]! + (n > 0 ? side : 0));
    }
    if (most < 0) return false;
  }
  return true;
}

/** A heap of nodes, the one with the largest cells first. */
class Heap {
  private readonly items: { node: Node; pixels: number }[] = [];

  push(node: Node, pixels: number): void {
    const items = this.items;
    let i = items.push({ node, pixels }) - 1;
    while (i > 0) {
      const up = (i - 1) >> 1;
      if (items[up]!.pixels >= items[i]!.pixels) break;
      [items[up], items[i]] = [items[i]!, items[up]!];
      i = up;
    }
  }

  pop(): { node: Node; pixels: number } | undefined {
    const items = this.items;
    const top = items[0];
    const last = items.pop();
    if (!last || items.length === 0) return top;
    items[0] = last;
    for (let i = 0; ; ) {
      let best = i;
      for (const child of [2 * i + 1, 2 * i + 2]) if (child < items.length && items[child]!.pixels > items[best]!.pixels) best = child;
      if (best === i) return top;
      [items[best], items[i]] = [items[i]!, items[best]!];
      i = best;
    }
  }
}

export interface Wanted {
  node: Node;
  pixels: number;
}

/** The nodes that should be shown: together they cover the map, and no two overlap. The nearest come first. */
export function choose(tree: Tree, camera: Camera, budget: Budget): Wanted[] {
  const heap = new Heap();
  const done: Wanted[] = [];
  let nodes = 0;
  let faces = 0;
  for (const root of tree.roots) {
    heap.push(root, cellPixels(root, camera));
    nodes++;
    faces += facesOf(root);
  }
  for (let top = heap.pop(); top; top = heap.pop()) {
    const { node, pixels } = top;
    const children = node.children?.filter((child): child is Node => child !== null);
    if (children && pixels > budget.pixels) {
      const more = children.reduce((sum, child) => sum + facesOf(child), 0) - facesOf(node);
      if (nodes + children.length - 1 <= budget.nodes && faces + more <= budget.faces) {
        nodes += children.length - 1;
        faces += more;
        for (const child of children) heap.push(child, cellPixels(child, camera));
        continue;
      }
    }
    done.push(top);
  }
  return done.sort((a, b) => b.pixels - a.pixels);
}

/** What to show of the wanted nodes while some of them are not built: finer ones or a coarser one that are. */
export function shown(tree: Tree, wanted: Wanted[], nodesMax: number): Node[] {
  const want = new Set<Node>(wanted.map((w) => w.node));
  const above = new Set<Node>();
  for (const { node } of wanted) for (let n = node.parent; n && !above.has(n); n = n.parent) above.add(n);
  const result: Node[] = [];
  for (const root of tree.roots) result.push(...collect(root, want, above).nodes);
  let faces = 0;
  return result.slice(0, nodesMax).filter((node) => (faces += node.built!.faces) <= FACES_MAX);
}

function collect(node: Node, want: Set<Node>, above: Set<Node>): { nodes: Node[]; whole: boolean } {
  if (want.has(node)) {
    if (node.built) return { nodes: [node], whole: true };
    return finer(node);
  }
  if (!above.has(node)) return { nodes: [], whole: false };
  const nodes: Node[] = [];
  let whole = true;
  for (const child of node.children!) {
    if (!child) continue;
    const part = collect(child, want, above);
    nodes.push(...part.nodes);
    whole &&= part.whole;
  }
  return !whole && node.built ? { nodes: [node], whole: true } : { nodes, whole };
}

/** The built nodes directly below one that is not built. */
function finer(node: Node): { nodes: Node[]; whole: boolean } {
  const nodes: Node[] = [];
  for (const child of node.children ?? [null]) {
    if (child?.built) nodes.push(child);
    else if (child || !node.children) return { nodes: [], whole: false };
  }
  return { nodes, whole: true };
}

/** Meshes that are not needed and for which there is no room: the ones unused for the longest time. */
export function surplus(tree: Tree, keep: Set<Node>, bytesMax: number): Node[] {
  let bytes = 0;
  for (const node of tree.meshes.values()) bytes += node.built!.faces * FACE_BYTES;
  if (bytes <= bytesMax) return [];
  const result: Node[] = [];
  const rest = [...tree.meshes.values()].filter((node) => !keep.has(node)).sort((a, b) => a.built!.used - b.built!.used);
  for (const node of rest) {
    if (bytes <= bytesMax) break;
    bytes -= node.built!.faces * FACE_BYTES;
    result.push(node);
  }
  return result;
}

/** Sets how many faces are drawn, and how sharp a moving picture is, by how long frames take. */
export class Governor {
  /** Share of the pixels of a side that are drawn while something moves. */
  sharpness = 1;
  private mean = 0;
  private since = 0;

  constructor(public faces: number) {}

  /** A frame of so many faces took so many milliseconds. Says whether something changed. */
  frame(ms: number, faces: number): boolean {
    this.mean = this.since === 0 ? ms : 0.75 * this.mean + 0.25 * ms;
    this.since++;
    if (this.since < 5) return false;
    const before = [this.faces, this.sharpness];
    if (this.mean > SLOW) {
      // What the frame costs beside the faces is not known: so the way to the aim is gone in steps.
      const least = Math.min(this.faces, FACES_MIN);
      this.faces = Math.max(least, Math.min(this.faces, faces) * Math.max(0.4, AIM / this.mean));
      if (this.faces < 4 * FACES_MIN || this.mean > 2 * SLOW) this.sharpness = Math.max(BLUNT, this.sharpness * 0.8);
    } else if (this.mean < FAST) {
      if (this.sharpness < 1) this.sharpness = Math.min(1, this.sharpness * 1.2);
      else if (faces > 0.7 * this.faces) this.faces = Math.min(FACES_MAX, this.faces * 1.25);
    }
    if (before[0] === this.faces && before[1] === this.sharpness) return false;
    this.since = 0;
    return true;
  }
}

export const SLOW = 75;
const AIM = 55;
const FAST = 30;
const BLUNT = 0.6;
export const FACES_MIN = 40_000;
/** A cell of so many pixels is fine enough. */
export const FINEST = 2;
export const NODES_MAX = 440;
export const FACES_MAX = 14_000_000;
