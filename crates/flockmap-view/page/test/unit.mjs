// Tests of what the worker does, without a browser. check.sh bundles and runs them.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Blocks, heightOfShare, ones } from "../src/blocks.ts";
import { FeedError, helloBytes, readBlocks, readCounters, readHello, readPoses, readSubmaps, Splitter } from "../src/feed.ts";
import { cellPixels, choose, FACES_MAX, FACES_MIN, facesOf, Governor, NODES_MAX, shown, surplus } from "../src/lod.ts";
import { mesh } from "../src/mesher.ts";
import { Mirror } from "../src/mirror.ts";
import { outline } from "../src/outline.ts";
import { Present } from "../src/present.ts";
import { Series, sum } from "../src/series.ts";
import { slice } from "../src/slice.ts";
import { Swarm } from "../src/swarm.ts";
import { TRAIL_MAX } from "../src/trail.ts";
import { Tree } from "../src/tree.ts";
import { random } from "./world.mjs";

const EXAMPLE = `
1f 00 00 00 01 46 4c 4b 4d 01 00 07 00 40 0d 03 00 88 77 66 55 44 33 22 11 05 61 6c 70 68 61 03 6d 61 70
09 00 00 00 03 05 00 00 00 00 00 00 00
aa 00 00 00 02 05 00 00 00 00 00 00 00 05 00 00 00 00 00 00 00 00 40 1e 18 24 0a 06 00 00 01 00
00 00 01 00 00 00 00 00 00 00 ff ff ff ff 06 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 80
4e 00 00 00 04 01 00 07 00 03 00 00 00 00 00 00 00 00 00 00 00 00 00 f0 3f 00 00 00 00 00 00 00
c0 00 00 00 00 00 00 e0 3f 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 f0 3f 60 e3 16 00 00 00 00 00
1f 00 00 00 05 60 23 35 18 24 0a 06 00 01 00 0b 6e 6f 64 65 5f 66 72 61 6d 65 73 2c 01 00 00 00 00 00 00
87 00 00 00 0a 01 00 07 00 03 00 00 00 00 00 00 00 04 00 00 00 02 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 f0 3f 02 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 e0 3f 00 00 00 00 00 00 d0 bf 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
00 00 00 00 00 00 00 00 00 f0 3f`;
const bytes = Uint8Array.from(EXAMPLE.trim().split(/\s+/), (hex) => parseInt(hex, 16));

const newMirror = () => new Mirror(() => 9, (robot) => robot);

/** A block with these occupied voxels in it. */
function block(x, y, z, voxels, robots = []) {
  const planes = new Uint8Array(128);
  for (const [a, b, c] of voxels) planes[64 + 8 * c + b] |= 1 << a;
  return { x, y, z, planes, robots, shares: [] };
}

function blocksFrame(list, upto, newest) {
  const body = new Uint8Array(29 + 140 * list.length);
  const view = new DataView(body.buffer);
  view.setBigUint64(0, BigInt(upto), true);
  view.setBigUint64(8, BigInt(newest), true);
  view.setUint32(25, list.length, true);
  list.forEach(({ x, y, z, planes }, i) => {
    [x, y, z].forEach((v, k) => view.setInt32(29 + 140 * i + 4 * k, v, true));
    body.set(planes, 29 + 140 * i + 12);
  });
  return body;
}

function anewFrame(version) {
  const body = new Uint8Array(8);
  new DataView(body.buffer).setBigUint64(0, BigInt(version), true);
  return body;
}

test("the example of the document, cut everywhere", () => {
  for (let cut = 0; cut <= bytes.length; cut += 7) {
    const mirror = newMirror();
    const kinds = [];
    const splitter = new Splitter();
    for (const piece of [bytes.subarray(0, cut), bytes.subarray(cut, cut + 3), bytes.subarray(cut + 3)]) {
      splitter.push(piece, (kind, body) => {
        kinds.push(kind);
        if (kind <= 3) mirror.frame(kind, body);
        if (kind === 4) {
          const [pose] = readPoses(body);
          assert.deepEqual(pose, { robot: 7, epoch: "3", at: [1, -2, 0.5], turned: [0, 0, 0, 1], age: 1.5 });
        }
        if (kind === 5) assert.equal(readCounters(body).values.get("node_frames"), 300);
        if (kind === 10) {
          const turned = [0, 0, 0, 1];
          const poses = [{ submap: 0, at: [0, 0, 0], turned }, { submap: 2, at: [0, 0.5, -0.25], turned }];
          assert.deepEqual(readSubmaps(body), [{ robot: 7, epoch: "3", newest: 4, poses }]);
        }
      });
    }
    assert.deepEqual(kinds, [1, 3, 2, 4, 5, 10]);
    assert.equal(mirror.hello.name, "alpha");
    assert.deepEqual([mirror.blocks.count, mirror.blocks.occupied, mirror.blocks.free, mirror.complete], [1, 2, 2, true]);
    assert.deepEqual(mirror.have(), { feed: 0x1122334455667788n, anew: 5n, upto: 5n });
  }
});

test("a hello is as the document says", () => {
  assert.deepEqual([...helloBytes(0, { feed: 0n, anew: 0n, upto: 0n })], [0x1f, 0, 0, 0, 1, 0x46, 0x4c, 0x4b, 0x4d, 1, 0, ...new Array(24).fill(0)]);
});

test("damage is an error, and nothing of a damaged frame is taken", () => {
  assert.throws(() => new Splitter().push(Uint8Array.of(0, 0, 0x20, 0, 2), () => {}), FeedError);
  assert.throws(() => new Splitter().push(Uint8Array.of(0, 0, 0, 0, 2), () => {}), FeedError);
  assert.throws(() => readHello(new Uint8Array(40)), FeedError);
  const both = block(0, 0, 0, [[0, 0, 0]]);
  both.planes[0] = 1;
  let taken = 0;
  assert.throws(() => readBlocks(blocksFrame([block(1, 1, 1, [[1, 1, 1]]), both], 2, 2), () => true, () => taken++), FeedError);
  assert.throws(() => readBlocks(blocksFrame([block(1, 1, 1, [])], 1, 1).subarray(0, 90), () => true, () => taken++), FeedError);
  assert.throws(() => readBlocks(blocksFrame([], 3, 2), () => true, () => taken++), FeedError);
  assert.equal(taken, 0);
});

test("a map that begins anew is shown when it is whole, and pauses hold what comes", () => {
  const mirror = newMirror();
  new Splitter().push(bytes, (kind, body) => kind <= 3 && mirror.frame(kind, body));
  mirror.frame(3, anewFrame(9));
  mirror.frame(2, blocksFrame([block(4, 4, 4, [[1, 2, 3]])], 3, 9));
  assert.ok(mirror.renewing);
  assert.equal(mirror.blocks.find(4, 4, 4), -1);
  assert.ok(mirror.blocks.find(1, 0, -1) >= 0);
  mirror.frame(2, blocksFrame([], 9, 9));
  assert.ok(!mirror.renewing);
  assert.equal(mirror.blocks.find(1, 0, -1), -1);
  assert.deepEqual(mirror.have(), { feed: 0x1122334455667788n, anew: 9n, upto: 9n });

  mirror.pause(true);
  mirror.frame(2, blocksFrame([block(5, 5, 5, [[0, 0, 0]]), block(4, 4, 4, [])], 10, 10));
  assert.equal(mirror.blocks.find(5, 5, 5), -1);
  assert.ok(mirror.blocks.find(4, 4, 4) >= 0);
  mirror.frame(3, anewFrame(11));
  mirror.frame(2, blocksFrame([block(6, 6, 6, [[0, 0, 0]])], 11, 11));
  assert.equal(mirror.blocks.find(6, 6, 6), -1);
  mirror.pause(false);
  assert.ok(mirror.blocks.find(6, 6, 6) >= 0);
  assert.equal(mirror.blocks.count, 1);

  mirror.pause(true);
  mirror.frame(2, blocksFrame([block(7, 7, 7, [[0, 0, 0]]), block(6, 6, 6, [])], 12, 12));
  mirror.pause(false);
  assert.equal(mirror.blocks.find(6, 6, 6), -1);
  assert.deepEqual([mirror.blocks.count, mirror.blocks.occupied], [1, 1]);
});

test("blocks: put, replace, remove in random order, against a Map", () => {
  const next = random(1);
  const blocks = new Blocks(400);
  const model = new Map();
  const at = () => Math.floor(next() * 8) - 4;
  for (let i = 0; i < 20_000; i++) {
    const [x, y, z] = [at(), at(), at()];
    const voxels = next() < 0.4 ? [] : Array.from({ length: 1 + Math.floor(next() * 9) }, () => [0, 0, 0].map(() => Math.floor(next() * 8)));
    const key = `${x},${y},${z}`;
    if (voxels.length > 0 && !model.has(key) && !blocks.hasRoom(1)) {
      assert.throws(() => blocks.put(block(x, y, z, voxels), i, () => 0), RangeError);
      continue;
    }
    const b = block(x, y, z, voxels);
    blocks.put(b, i, () => 0);
    if (voxels.length > 0) model.set(key, b.planes);
    else model.delete(key);
  }
  let occupied = 0;
  for (const [key, planes] of model) {
    assert.deepEqual([...blocks.planes(blocks.find(...key.split(",").map(Number)))], [...planes]);
    occupied += planes.reduce((n, byte) => n + ones(byte), 0);
  }
  assert.deepEqual([blocks.count, blocks.occupied, blocks.free], [model.size, occupied, 0]);
  const total = [...blocks.heights.values()].reduce((n, row) => n + row.reduce((a, b) => a + b, 0), 0);
  assert.equal(total, occupied);
});

test("robots of voxels, and the one that saw most", () => {
  const blocks = new Blocks();
  const b = block(0, 0, 0, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [4, 5]);
  const [four, five] = [new Uint8Array(64), new Uint8Array(64)];
  four[0] = 1;
  five[0] = 6;
  b.shares = [four, five];
  blocks.put(b, 1, (robot) => robot);
  assert.deepEqual([blocks.owner(0), blocks.ownerOf(0, 0), blocks.ownerOf(0, 1), blocks.ownerOf(0, 2)], [5, 4, 5, 5]);
});

/** A world of random blocks, some of them full, on both sides of zero. */
function randomWorld(seed, count, spread) {
  const next = random(seed);
  const blocks = new Blocks();
  const tree = new Tree();
  const cells = new Set();
  const at = () => Math.floor((next() - 0.5) * spread);
  for (let i = 0; i < count; i++) {
    const [x, y, z] = [at(), at(), at()];
    const dense = next();
    const voxels = [];
    for (let v = 0; v < 512; v++) if (next() < dense) voxels.push([v & 7, (v >> 3) & 7, v >> 6]);
    const b = block(x, y, z, voxels);
    blocks.put(b, i, () => 0);
    tree.touch(x, y, z, voxels.length > 0, i, 0);
    tree.touchBeside(x, y, z);
  }
  blocks.each((slot, x, y, z) => {
    const planes = blocks.planes(slot);
    for (let v = 0; v < 512; v++) if ((planes[64 + (v >> 3)] >> (v & 7)) & 1) cells.add(`${8 * x + (v & 7)},${8 * y + ((v >> 3) & 7)},${8 * z + (v >> 6)}`);
  });
  return { blocks, tree, cells };
}

function* nodesOf(tree) {
  const stack = [...tree.roots];
  for (let node = stack.pop(); node; node = stack.pop()) {
    yield node;
    for (const child of node.children ?? []) if (child) stack.push(child);
  }
}

const STEPS = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]];

/** Faces of a node, one by one; from level 1 on, what is outside of the node counts as empty. */
function naive(node, cells) {
  const side = 2 ** node.level;
  const own = new Set();
  const all = new Set();
  for (const cell of cells) {
    const at = cell.split(",").map((v) => Math.floor(Number(v) / side));
    const inside = at.every((v, i) => v >> 6 === [node.x, node.y, node.z][i]);
    if (inside) own.add(at.join());
    if (inside || node.level === 0) all.add(at.join());
  }
  const faces = new Set();
  for (const cell of own) {
    const at = cell.split(",").map(Number);
    STEPS.forEach((step, direction) => {
      if (!all.has(at.map((v, i) => v + step[i]).join())) faces.add(`${at.map((v) => v & 63).join()},${direction}`);
    });
  }
  return faces;
}

test("faces of all levels are those of a naive count", () => {
  for (const [seed, count, spread] of [[1, 40, 6], [2, 60, 30], [3, 30, 200], [4, 12, 30_000]]) {
    const { blocks, tree, cells } = randomWorld(seed, count, spread);
    let levels = 0;
    for (const node of nodesOf(tree)) {
      const { count: faces, words } = mesh(blocks, node);
      const got = new Set();
      for (let i = 0; i < faces; i++) {
        const a = words[2 * i];
        got.add(`${a & 63},${(a >> 6) & 63},${(a >> 12) & 63},${(a >> 18) & 7}`);
      }
      const want = naive(node, cells);
      assert.equal(got.size, faces);
      assert.deepEqual([...got].sort(), [...want].sort(), `level ${node.level}`);
      levels = Math.max(levels, node.level);
    }
    if (spread > 1_000) assert.ok(levels > 6);
  }
});

test("a face has the time and the robot of its block, and its corners are darker in a corner", () => {
  const blocks = new Blocks();
  const tree = new Tree();
  blocks.put(block(0, 0, 0, [[1, 1, 1], [2, 1, 2]], [3]), 1234, (robot) => robot);
  tree.touch(0, 0, 0, true, 1234, 3);
  const { count, words } = mesh(blocks, tree.leaf(0, 0, 0, false));
  assert.equal(count, 12);
  for (let i = 0; i < count; i++) {
    const [a, b] = [words[2 * i], words[2 * i + 1]];
    assert.deepEqual([(a >>> 21) & 255, b & 0xffffff], [3, 1234]);
    // The top of the lower voxel, beside which the other stands: its corners at x = 1 are shaded.
    if ((a & 0x1fffff) === (1 | (1 << 6) | (1 << 12) | (5 << 18))) assert.deepEqual([0, 2, 4, 6].map((s) => (b >>> (24 + s)) & 3), [3, 2, 3, 2]);
  }
});

test("emptied nodes go, and so do their meshes", () => {
  const { blocks, tree } = randomWorld(5, 200, 60);
  for (const node of nodesOf(tree)) {
    node.built = { faces: 1, changes: node.changes, at: 0, used: 0 };
    tree.meshes.set(node.id, node);
  }
  const count = tree.meshes.size;
  blocks.each((slot, x, y, z) => tree.touch(x, y, z, false, 1, 0));
  assert.equal(tree.roots.length, 0);
  assert.equal(tree.removed.length, count);
});

const ahead = { eye: [0, 0, 40], planes: [], focal: 900 };

test("what is chosen covers the map once and keeps to the budget; the nearest are finest", () => {
  const { tree } = randomWorld(6, 4_000, 300);
  for (const budget of [{ pixels: 2, nodes: 440, faces: 1e7 }, { pixels: 2, nodes: 40, faces: 1e7 }, { pixels: 2, nodes: 440, faces: 60_000 }, { pixels: 1e9, nodes: 440, faces: 1e7 }]) {
    const list = choose(tree, ahead, budget);
    assert.ok(list.length <= Math.max(budget.nodes, tree.roots.length));
    const faces = list.reduce((n, w) => n + facesOf(w.node), 0);
    assert.ok(faces <= Math.max(budget.faces, tree.roots.reduce((n, r) => n + facesOf(r), 0)));
    assert.equal(list.reduce((n, w) => n + w.node.blocks, 0), tree.roots.reduce((n, r) => n + r.blocks, 0));
    for (const { node } of list) for (let up = node.parent; up; up = up.parent) assert.ok(!list.some((w) => w.node === up));
  }
  const fine = choose(tree, ahead, { pixels: 2, nodes: 440, faces: 1e7 });
  assert.ok(fine[0].node.level <= fine.at(-1).node.level);
  assert.ok(cellPixels(fine[0].node, ahead) >= fine.at(-1).pixels);
  const behind = { ...ahead, planes: [1, 0, 0, -1e6] };
  assert.ok(cellPixels(tree.roots[0], behind) < cellPixels(tree.roots[0], ahead));
});

test("there are no holes while meshes come: finer ones or a coarser one stand in", () => {
  const { tree } = randomWorld(7, 2_000, 200);
  const build = (node) => {
    node.built = { faces: 10, changes: node.changes, at: 0, used: 0 };
    tree.meshes.set(node.id, node);
  };
  tree.roots.forEach(build);
  const wanted = choose(tree, ahead, { pixels: 2, nodes: NODES_MAX, faces: 1e7 });
  const all = tree.roots.reduce((n, r) => n + r.blocks, 0);
  const next = random(3);
  for (const { node } of [...wanted].sort(() => next() - 0.5)) {
    const list = shown(tree, wanted, NODES_MAX);
    assert.equal(list.reduce((n, node) => n + node.blocks, 0), all);
    build(node);
  }
  assert.deepEqual(new Set(shown(tree, wanted, NODES_MAX)), new Set(wanted.map((w) => w.node)));
  // Coarser ones are wanted that are not built: the finer ones stay.
  const coarse = choose(tree, { ...ahead, focal: 1 }, { pixels: 0.3, nodes: NODES_MAX, faces: 1e7 });
  assert.equal(shown(tree, coarse, NODES_MAX).reduce((n, node) => n + node.blocks, 0), all);
});

test("meshes have a limit: those that were used last stay", () => {
  const { tree } = randomWorld(8, 300, 60);
  let i = 0;
  for (const node of nodesOf(tree)) {
    node.built = { faces: 1_000, changes: 1, at: 0, used: i++ };
    tree.meshes.set(node.id, node);
  }
  const keep = new Set(tree.roots);
  const gone = surplus(tree, keep, 8_000 * 5);
  assert.equal(tree.meshes.size - gone.length, Math.max(5, keep.size));
  assert.ok(gone.every((node) => !keep.has(node)));
});

test("the governor comes to frames that are fast enough, and back to full detail", () => {
  // A renderer that takes 20 ms and 2 µs a face; the scene has at most two million.
  const slow = new Governor(FACES_MAX / 4);
  let ms = 0;
  for (let i = 0; i < 120; i++) {
    const faces = Math.min(slow.faces, 2e6);
    ms = 20 + faces * 2e-3;
    slow.frame(ms, faces);
  }
  assert.ok(ms < 110 && slow.faces >= FACES_MIN, `${ms} ms, ${slow.faces} faces`);
  const fast = new Governor(FACES_MIN);
  for (let i = 0; i < 400; i++) fast.frame(8, Math.min(fast.faces, 1e8));
  assert.equal(fast.faces, FACES_MAX);
  assert.equal(fast.sharpness, 1);
});

test("a slice has each state where it is, and a bounded size", () => {
  const blocks = new Blocks();
  const b = block(-1, 0, 0, [[7, 0, 3]]);
  b.planes[8 * 3 + 1] = 1;
  blocks.put(b, 0, () => 0);
  blocks.put(block(0, 0, 0, [[0, 0, 4]]), 0, () => 0);
  const s = slice(blocks, 3);
  assert.deepEqual([s.x, s.y, s.width, s.height, s.step], [-8, 0, 16, 8, 1]);
  assert.deepEqual([s.texels[7], s.texels[16], s.texels[0], s.texels.reduce((a, c) => a + c, 0)], [2, 1, 0, 3]);
  assert.equal(slice(blocks, 100), null);
  blocks.put(block(4_000, 9, 0, [[1, 1, 3]]), 0, () => 0);
  const wide = slice(blocks, 3);
  assert.ok(wide.width <= 2_048 && wide.step === 16);
});

test("heights of shares", () => {
  const blocks = new Blocks();
  for (let z = -5; z < 5; z++) blocks.put(block(0, 0, z, [[0, 0, 0]]), 0, () => 0);
  assert.deepEqual([0.02, 0.5, 1].map((share) => heightOfShare(blocks, share)), [-40, -8, 32]);
  assert.equal(heightOfShare(new Blocks(), 0.5), null);
});

test("series: of the server, then of counters, with 28 bytes a datagram", () => {
  const series = new Series();
  series.load({ begin_us: 100e6, step_s: 1, names: ["sent", "racer"], bytes: [[10, 20], [900, null]] });
  assert.deepEqual([series.at(100, "sent"), series.at(100, "racer"), series.at(101, "racer"), series.at(101, "received")], [10, 900, null, null]);
  const counters = (time, out, datagrams) => ({ time, values: new Map([["node_bytes_out", out], ["node_datagrams_out", datagrams], ["node_bytes_in", 0]]) });
  assert.equal(series.count(counters(102.1, 1_000, 10), true), null);
  assert.deepEqual(series.count(counters(103.1, 1_500, 12), true), { sent: 556, received: 0 });
  assert.equal(series.count(counters(103.2, 1_600, 12), true), undefined, "too near to say");
  assert.equal(series.count(counters(200, 9_000, 12), true), null, "a jump");
  assert.equal(Math.round(series.at(102, "sent")), 556);
  const other = new Series();
  assert.equal(sum([series, other], 101, "sent"), 20);
  assert.equal(sum([series, other], 50, "sent"), null);
  for (let t = 0; t < 9_000; t++) other.load({ begin_us: t * 1e6, step_s: 1, names: ["sent"], bytes: [[t]] });
  assert.deepEqual([other.first, other.newest, other.at(3_000, "sent")], [5_400, 8_999, null]);
});

test("rates of a link are over the time that is shown, and unknown after a jump", () => {
  const swarm = new Swarm([{ id: 1, name: "a" }, { id: 2, name: "b" }]);
  const rates = (bytes, at) => {
    swarm.links(1, [{ robot: 2, bytesIn: bytes, bytesOut: 2 * bytes }], at);
    const link = swarm.get(1).links.get(2);
    return [link.rateIn, link.rateOut];
  };
  const unknown = [null, null];
  assert.deepEqual(rates(1_000, 100), unknown);
  assert.deepEqual(rates(1_500, 102), [250, 500]);
  assert.deepEqual(rates(90_000, 160), unknown, "far ahead");
  assert.deepEqual(rates(90_300, 161), [300, 600]);
  assert.deepEqual(rates(1_500, 102), unknown, "back");
  assert.deepEqual(rates(1_500, NaN), unknown);
});

test("trails have a limit, and keep their first and last point", () => {
  const swarm = new Swarm([{ id: 1, name: "a" }]);
  for (let i = 0; i < 10_000; i++) swarm.poses(1, [{ robot: 1, epoch: "1", at: [i, 0, 0], turned: null, age: 0 }]);
  const { trail } = swarm.get(1);
  const { points } = trail;
  assert.ok(points.length <= 3 * TRAIL_MAX && points.length > TRAIL_MAX);
  assert.deepEqual([points[0], points.at(-3)], [0, 9_999]);
  swarm.poses(1, [{ robot: 1, epoch: "2", at: [0, 0, 0], turned: null, age: 0 }]);
  assert.equal(points.length, 3);
});

/** A run of robot 1 whose submaps lie so: numbers to places and turns about z. */
function run(poses, epoch = "1") {
  const list = Object.entries(poses).map(([submap, [x, y, yaw]]) => ({ submap: Number(submap), at: [x, y, 0], turned: [0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)] }));
  return { robot: 1, epoch, newest: Math.max(...list.map(({ submap }) => submap)), poses: list };
}

test("a trail moves with the submaps in which it was flown, and with no others", () => {
  const swarm = new Swarm([{ id: 1, name: "a" }, { id: 2, name: "b" }]);
  const fly = (x) => swarm.poses(1, [{ robot: 1, epoch: "1", at: [x, 0, 0], turned: null, age: 0 }]);
  swarm.submaps(1, [run({ 0: [0, 0, 0] })]);
  fly(1);
  // The second begins, and lies as the first does; the third lies otherwise from the beginning.
  swarm.submaps(1, [{ ...run({ 0: [0, 0, 0] }), newest: 1 }]);
  fly(2);
  swarm.submaps(1, [run({ 0: [0, 0, 0], 2: [0, 1, 0] })]);
  fly(3);
  const robot = swarm.get(1);
  assert.equal(robot.moved, null);
  const near = (expected) => robot.trail.points.forEach((v, i) => assert.ok(Math.abs(v - expected[i]) < 1e-9, `${robot.trail.points}`));
  near([1, 0, 0, 2, 0, 0, 3, 0, 0]);

  // A quarter turn of the second about the zero of the map, and of the third about where it lies.
  swarm.submaps(1, [run({ 0: [0, 0, 0], 1: [0, 0, Math.PI / 2], 2: [0, 1, Math.PI / 2] })]);
  near([1, 0, 0, 0, 2, 0, 1, 4, 0]);
  assert.ok(Math.abs(robot.moved - Math.hypot(2, 4)) < 1e-9);
  // As they were: nothing is lost on the way.
  swarm.submaps(1, [run({ 0: [0, 0, 0], 2: [0, 1, 0] })]);
  near([1, 0, 0, 2, 0, 0, 3, 0, 0]);
  // Another robot knows it otherwise, and it says itself how it lies.
  swarm.submaps(2, [run({ 0: [9, 9, 0] })]);
  near([1, 0, 0, 2, 0, 0, 3, 0, 0]);
  assert.equal(swarm.get(2).runs.length, 1);
  // Another run has nothing to do with this one.
  swarm.submaps(1, [run({ 0: [5, 0, 0] }, "2")]);
  near([1, 0, 0, 2, 0, 0, 3, 0, 0]);
  assert.equal(robot.moved, null);
});

test("a trail that was thinned still knows its submaps", () => {
  const swarm = new Swarm([{ id: 1, name: "a" }]);
  for (let i = 0; i < 4 * TRAIL_MAX; i++) {
    swarm.submaps(1, [{ ...run({ 0: [0, 0, 0] }), newest: Math.floor(i / 100) }]);
    swarm.poses(1, [{ robot: 1, epoch: "1", at: [i, 0, 0], turned: null, age: 0 }]);
  }
  swarm.submaps(1, [{ ...run({ 0: [0, 0, 0], 40: [0, 1, 0], 41: [0, 0, 0] }), newest: 59 }]);
  const { points } = swarm.get(1).trail;
  let moved = 0;
  for (let i = 0; i < points.length; i += 3) {
    const inside = points[i] >= 4_000 && points[i] < 4_100;
    assert.equal(points[i + 1], inside ? 1 : 0, `at ${points[i]}`);
    moved += inside;
  }
  assert.ok(moved > 0);
});

test("submaps that are none are refused", () => {
  const body = bytes.subarray(bytes.length - 134);
  assert.equal(readSubmaps(body).length, 1);
  const damaged = (at, put) => {
    const copy = body.slice();
    put(new DataView(copy.buffer), at);
    return copy;
  };
  assert.throws(() => readSubmaps(damaged(20, (view, at) => view.setFloat64(at, NaN, true))), FeedError);
  assert.throws(() => readSubmaps(damaged(68, (view, at) => view.setFloat64(at, 2, true))), FeedError);
  assert.throws(() => readSubmaps(damaged(16, (view, at) => view.setUint16(at, 9_000, true))), FeedError);
  assert.throws(() => readSubmaps(body.subarray(0, 100)), FeedError);
});

test("players are told the same time, and one that begins is brought to it", () => {
  let now = 0;
  const present = new Present(() => now);
  const shown = { begin: 10, end: 70, at: 20, speed: 2, plays: true, grows: false };
  assert.deepEqual(present.words(), []);
  assert.deepEqual(present.wish({ play: false }), []);
  assert.ok(present.hear(shown));
  now = 3_000;
  assert.deepEqual(present.words(), ['{"speed":2}', '{"play":true}', '{"seek_us":26000000}']);
  // What the player that has just begun says of its beginning does not count.
  assert.ok(!present.hear({ ...shown, at: 10 }));
  assert.ok(present.hear({ ...shown, at: 26.1 }));
  assert.deepEqual(present.wish({ seek: 70 }), ['{"seek_us":70000000}']);
  assert.ok(!present.hear({ ...shown, at: 26.2 }));
  now = 4_500;
  assert.ok(present.hear({ ...shown, at: 70, plays: false }));
  assert.deepEqual(present.wish({ play: true }), ['{"seek_us":10000000}', '{"play":true}']);
  assert.deepEqual(present.wish({ speed: 4 }), ['{"speed":4}']);
});

test("the outline of a map has its outermost blocks and few others", () => {
  const blocks = new Blocks();
  for (let x = -9; x <= 9; x++) for (let y = -4; y <= 4; y++) blocks.put(block(x, y, 0, [[0, 0, 0]]), 0, () => 0);
  blocks.put(block(100, 0, 0, []), 0, () => 0);
  const places = outline(blocks);
  assert.ok(places.length % 3 === 0 && places.length <= 3 * 48);
  const along = (axis) => places.filter((_, i) => i % 3 === axis);
  assert.deepEqual([Math.min(...along(0)), Math.max(...along(0)), Math.min(...along(1)), Math.max(...along(1))], [-68, 76, -28, 36]);
  assert.deepEqual(outline(new Blocks()), []);
});
