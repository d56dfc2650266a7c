// The worker of the page: holds the mirror, builds meshes and slices, and tells the page what there is to show.

import { heightOfShare } from "./blocks";
import { Connection } from "./connection";
import * as feed from "./feed";
import { choose, NODES_MAX, shown, surplus, type Budget, type Camera, type Wanted } from "./lod";
import { mesh } from "./mesher";
import { outline } from "./outline";
import { Mirror } from "./mirror";
import { Present } from "./present";
import type { Connected, FromWorker, RobotName, ToWorker } from "./protocol";
import { slice } from "./slice";
import type { Node, Tree } from "./tree";

const ROBOTS_MAX = 32;
const MESH_BYTES_MAX = 256 << 20;
/** Milliseconds of building before messages are looked at again. */
const BUILD = 12;
/** A mesh is built again at most so often; coarser ones, which change all the time, less often. */
const AGAIN = 300;
const AGAIN_MAX = 3_000;

const NOTHING: feed.Have = { feed: 0n, anew: 0n, upto: 0n };
let feeds = "";
let query = "";
let live = true;
let robots: RobotName[] = [];
let chosen = -1;
let origins = false;
let scans = false;
let mirror = newMirror();
let connections = new Map<number, Connection>();
const present = new Present(() => performance.now());
let camera: Camera | null = null;
let budget: Budget = { pixels: 4, nodes: NODES_MAX, faces: 1_000_000 };
let wanted: Wanted[] = [];
/** The tree that `wanted` is of: the mirror may have got another one since. */
let planned: Tree | null = null;
let sliceZ: number | null = null;
let paused = false;
let said = "";
/** Where the player of each robot is, in seconds on the clock of the recording. */
const times = new Map<number, number>();
let sliced = "";

/** Tenths of a second since the worker began, from 1 on: 0 is what was there before. */
function clock(): number {
  return Math.floor(performance.now() / 100) + 1;
}

function newMirror(): Mirror {
  return new Mirror(clock, (robot) => robots.findIndex((r) => r.id === robot) + 1);
}

function post(message: FromWorker, transfer: Transferable[] = []): void {
  (self as DedicatedWorkerGlobalScope).postMessage(message, transfer);
}

self.onmessage = (event: MessageEvent<ToWorker>) => {
  const message = event.data;
  switch (message.kind) {
    case "start":
      ({ feeds, query, live } = message);
      robots = message.robots.slice(0, ROBOTS_MAX);
      break;
    case "choose":
      pick(message.robot, message.origins, message.scans);
      break;
    case "camera":
      ({ camera, budget } = message);
      plan();
      break;
    case "slice":
      sliceZ = message.z;
      sliced = "";
      tellSlice();
      break;
    case "pause":
      paused = message.paused;
      mirror.pause(paused);
      break;
    case "playback":
      for (const text of present.wish(message.wish)) for (const connection of connections.values()) connection.say(text);
      break;
    case "ask":
      post({ kind: "answer", ask: message.ask, value: message.what === "blocks" ? blocksOf() : facesOf() });
  }
};

function pick(robot: number, withOrigins: boolean, withScans: boolean): void {
  const other = robot !== chosen;
  if (!other && origins === withOrigins && scans === withScans && connections.size > 0) return;
  const all = other || scans !== withScans;
  if (other) {
    const removed = [...mirror.tree.meshes.keys()];
    const next = mirror.tree.successor();
    mirror = newMirror();
    mirror.tree = next;
    mirror.pause(paused);
    post({ kind: "show", ids: [], drop: removed });
  } else if (withOrigins && !origins) {
    // Whose voxels they are is only said of blocks that come: so all must come once more.
    mirror.restart();
  }
  [chosen, origins, scans] = [robot, withOrigins, withScans];
  if (all) {
    for (const connection of connections.values()) connection.close();
    connections = new Map(robots.map(({ id }) => [id, id === chosen ? chosenFeed(id) : lightFeed(id)]));
  } else {
    connections.get(chosen)?.renew();
  }
}

function stateOf(robot: number, connected: Connected): void {
  if (connected.state === "open" && !live) for (const text of present.words()) connections.get(robot)?.say(text);
  post({ kind: "connected", robot, connected });
}

/** The feed with the map. Of a recording each connection counts the versions by itself, so it always begins anew. */
function chosenFeed(robot: number): Connection {
  return new Connection(`${feeds}${robot}${query}`, {
    flags: () => (origins ? feed.WANT_ORIGINS : 0) | feed.WANT_LINKS | feed.WANT_SUBMAPS | (scans ? feed.WANT_SCANS : 0),
    have: () => (live ? mirror.have() : NOTHING),
    state: (connected) => stateOf(robot, connected),
    talks: () => live,
    frame: (kind, body) => {
      if (kind <= 3) mirror.frame(kind, body);
      else other(robot, kind, body);
      post({ kind: "heard", robot });
    },
  });
}

/** The feed of another robot: without its map. */
function lightFeed(robot: number): Connection {
  return new Connection(`${feeds}${robot}${query}`, {
    flags: () => feed.WANT_NO_MAP | feed.WANT_LINKS | feed.WANT_SUBMAPS | (scans ? feed.WANT_SCANS : 0),
    have: () => NOTHING,
    state: (connected) => stateOf(robot, connected),
    talks: () => live,
    frame: (kind, body) => {
      if (kind === 1) feed.readHello(body);
      else other(robot, kind, body);
      post({ kind: "heard", robot });
    },
  });
}

function other(robot: number, kind: number, body: Uint8Array): void {
  if (kind === 4) post({ kind: "poses", robot, poses: feed.readPoses(body) });
  else if (kind === 5) post({ kind: "counters", robot, counters: feed.readCounters(body) });
  else if (kind === 7) post({ kind: "links", robot, links: feed.readLinks(body), at: live ? Date.now() / 1e3 : times.get(robot) ?? NaN });
  else if (kind === 8) post({ kind: "scan", robot, scan: feed.readScan(body) });
  else if (kind === 10) post({ kind: "submaps", robot, runs: feed.readSubmaps(body) });
  else if (kind === 9) {
    const playback = feed.readPlayback(body);
    times.set(robot, playback.at);
    if (robot === chosen && present.hear(playback)) post({ kind: "shown-playback", playback });
  }
}

/** Looks which nodes should be shown, and which meshes may go. */
function plan(): void {
  const { tree } = mirror;
  if (!camera) return;
  wanted = choose(tree, camera, budget);
  planned = tree;
  const show = shown(tree, wanted, NODES_MAX);
  const now = performance.now();
  for (const node of show) node.built!.used = now;
  for (const { node } of wanted) if (node.built) node.built.used = now;
  const keep = new Set([...show, ...tree.roots, ...wanted.map((w) => w.node)]);
  for (const node of surplus(tree, keep, MESH_BYTES_MAX)) {
    tree.meshes.delete(node.id);
    tree.removed.push(node.id);
    node.built = null;
  }
  post({ kind: "show", ids: show.map((node) => node.id), drop: tree.removed });
  tree.removed = [];
}

function due(node: Node, now: number): boolean {
  if (!node.built) return true;
  return node.stale && now - node.built.at > Math.min(AGAIN_MAX, AGAIN * 2 ** node.level);
}

/** Builds for a while, the nearest nodes first; those without a mesh before those whose mesh is old. */
function build(): void {
  const begin = performance.now();
  const { tree } = mirror;
  if (planned !== tree) plan();
  const nodes = wanted.map((w) => w.node);
  // The roots are a picture of the whole map that is soon made: there is something to show until finer ones are there.
  const missing = [...tree.roots, ...nodes].filter((node) => !node.built && node.blocks > 0);
  const old = [...nodes, ...tree.roots].filter((node) => node.built && node.blocks > 0 && due(node, begin));
  let built = 0;
  for (const node of [...missing, ...old]) {
    if (!due(node, begin)) continue;
    if (performance.now() - begin > BUILD) break;
    const { count, words } = mesh(mirror.blocks, node);
    node.built = { faces: count, changes: node.changes, at: performance.now(), used: begin };
    tree.meshes.set(node.id, node);
    const side = node.side;
    post({ kind: "mesh", id: node.id, level: node.level, origin: [node.x * side, node.y * side, node.z * side], faces: count, words }, [words.buffer]);
    built++;
  }
  if (built > 0) plan();
  setTimeout(build, built > 0 ? 0 : 60);
}

function tellMap(): void {
  const { hello, blocks, tree } = mirror;
  if (!hello) return;
  const pending = wanted.filter((w) => w.node.blocks > 0 && w.node.stale).length;
  const key = `${chosen} ${mirror.upto} ${mirror.newest} ${mirror.complete} ${mirror.renewing} ${blocks.count} ${blocks.occupied} ${blocks.free} ${pending}`;
  if (key === said) return;
  said = key;
  const [low, high] = [heightOfShare(blocks, 0.02), heightOfShare(blocks, 0.98)];
  post({
    kind: "map",
    clock: clock(),
    map: {
      robot: hello.robot,
      name: hello.name,
      frame: hello.frame,
      voxel: mirror.voxel || hello.micrometres / 1e6,
      upto: mirror.upto.toString(),
      newest: mirror.newest.toString(),
      stamp: mirror.stamp,
      complete: mirror.complete,
      renewing: mirror.renewing,
      occupied: blocks.occupied,
      free: blocks.free,
      blocks: blocks.count,
      bounds: tree.roots.length > 0 ? boundsOf(tree.roots) : null,
      outline: outline(blocks),
      heights: low === null || high === null ? null : [low, high + 1],
      pending,
      bytes: blocks.bytes(),
    },
  });
  // The tree may have grown: what is wanted of it is another thing then.
  plan();
}

function tellSlice(): void {
  if (sliceZ === null) return;
  const key = `${chosen} ${sliceZ} ${mirror.upto} ${mirror.blocks.count} ${mirror.blocks.free} ${mirror.blocks.occupied}`;
  if (key === sliced) return;
  sliced = key;
  const message = slice(mirror.blocks, sliceZ);
  post(message ?? { kind: "slice", x: 0, y: 0, z: sliceZ, step: 1, width: 0, height: 0, texels: new Uint8Array(0) });
}

/** Low and high corner of what is occupied, to the side of a block. */
function boundsOf(roots: Node[]): [number, number, number, number, number, number] {
  const bounds: [number, number, number, number, number, number] = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
  const grow = (low: readonly [number, number, number], side: number, below: () => void): void => {
    if (!low.every((at, axis) => at >= bounds[axis]! && at + side <= bounds[axis + 3]!)) below();
  };
  const visit = (node: Node): void => {
    const { side, filled } = node;
    const low = [node.x * side, node.y * side, node.z * side] as const;
    grow(low, side, () => {
      for (const child of node.children ?? []) if (child) visit(child);
      for (let bit = 0; filled && bit < 512; bit++) {
        if (((filled[bit >> 5]! >>> (bit & 31)) & 1) === 0) continue;
        const block = [low[0] + 8 * (bit & 7), low[1] + 8 * ((bit >> 3) & 7), low[2] + 8 * (bit >> 6)] as const;
        for (let axis = 0; axis < 3; axis++) {
          bounds[axis] = Math.min(bounds[axis]!, block[axis]!);
          bounds[axis + 3] = Math.max(bounds[axis + 3]!, block[axis]! + 8);
        }
      }
    });
  };
  roots.forEach(visit);
  return bounds;
}

function blocksOf(): number[][] {
  const list: number[][] = [];
  const { blocks } = mirror;
  blocks.each((slot, x, y, z) => {
    const planes = blocks.planes(slot);
    const count = (from: number) => planes.subarray(from, from + 64).reduce((sum, byte) => sum + byte.toString(2).replaceAll("0", "").length, 0);
    list.push([x, y, z, count(0), count(64)]);
  });
  return list;
}

function facesOf(): { x: number; y: number; z: number; faces: number }[] {
  return wanted
    .filter(({ node }) => node.level === 0 && node.built && !node.stale)
    .map(({ node }) => ({ x: node.x, y: node.y, z: node.z, faces: node.built!.faces }));
}

build();
setInterval(tellMap, 250);
setInterval(tellSlice, 500);
