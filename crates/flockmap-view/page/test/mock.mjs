// A server with what docs/view.md says, and a made-up map: for tests of the page without a robot.
//
// usage: node test/mock.mjs [--port 8080] [--side 400] [--robots 3] [--playback] [--still]    (--side 1500: 5 million occupied voxels)

import { createServer } from "node:http";
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { WebSocketServer } from "ws";
import { forest, ground } from "./world.mjs";

const assets = fileURLToPath(new URL("../../assets/", import.meta.url));
const types = { "/": "text/html; charset=utf-8", "/view.js": "text/javascript", "/worker.js": "text/javascript", "/view.css": "text/css" };
const CSP =
  "default-src 'self'; style-src 'self' 'unsafe-inline'; worker-src 'self'; connect-src 'self'; img-src 'self' data: blob:";
const VOXEL = 0.2;
const SECONDS = 120;

class Writer {
  parts = [];
  put(bytes, write) {
    const buffer = Buffer.alloc(bytes);
    write(buffer);
    this.parts.push(buffer);
    return this;
  }
  u8 = (v) => this.put(1, (b) => b.writeUInt8(v));
  u16 = (v) => this.put(2, (b) => b.writeUInt16LE(v));
  u32 = (v) => this.put(4, (b) => b.writeUInt32LE(v));
  i32 = (v) => this.put(4, (b) => b.writeInt32LE(v));
  u64 = (v) => this.put(8, (b) => b.writeBigUInt64LE(BigInt(Math.round(Number(v)))));
  f32 = (v) => this.put(4, (b) => b.writeFloatLE(v));
  f64 = (v) => this.put(8, (b) => b.writeDoubleLE(v));
  raw = (bytes) => (this.parts.push(Buffer.from(bytes)), this);
  text = (s) => this.u8(Buffer.byteLength(s)).raw(Buffer.from(s));
  frame(kind) {
    const body = Buffer.concat(this.parts);
    const head = Buffer.alloc(5);
    head.writeUInt32LE(body.length + 1);
    head[4] = kind;
    return Buffer.concat([head, body]);
  }
}

/** Options: port, side, robots, playback, still, token. What it gives has `cut`, `stall`, `damage`, `end`, `restart` and `close`. */
export async function start(options = {}) {
  const world = options.world ?? forest(options.side ?? 400);
  const robots = Array.from({ length: options.robots ?? 3 }, (_, i) => ({ id: i + 1, name: `robot${i + 1}`, epoch: 1, out: 40_000 * (i + 1), in: 70_000, datagrams: 300 }));
  const playback = options.playback ? { at: 0, plays: false, speed: 1 } : null;
  const begun = Date.now();
  const zero = 1_700_000_000_000_000;
  const now = () => (playback ? zero + playback.at * 1e6 : zero + 1000 * (Date.now() - begun) + 200e6);
  /** Blocks in the order in which they changed last. */
  let order = [...world.blocks.keys()];
  const changedAt = new Map(order.map((key, i) => [key, i + 1]));
  let version = order.length;
  let feedId = 77;
  const clients = new Set();
  const control = { stalled: false, slow: 0 };

  function change(key) {
    version++;
    changedAt.set(key, version);
    order.push(key);
  }

  /** Where a robot is at a time, and how it is turned. */
  function pose(robot, seconds) {
    const a = seconds * 0.11 + robot.id * 2.1;
    const r = 14 + 6 * Math.sin(seconds * 0.05 + robot.id);
    const [x, y] = [r * Math.cos(a), r * Math.sin(a)];
    const z = ground(Math.round(x / VOXEL), Math.round(y / VOXEL)) * VOXEL + 3 + 0.5 * Math.sin(seconds / 3);
    return { at: [x, y, z], turned: [0, 0, Math.sin((a + Math.PI / 2) / 2), Math.cos((a + Math.PI / 2) / 2)] };
  }
  const time = () => (playback ? playback.at : (Date.now() - begun) / 1000);

  /** How far the map is at the time of a playback, as a version. */
  const limit = () => (playback ? Math.max(1, Math.round((order.length * playback.at) / SECONDS)) : version);

  function blocks(client) {
    const w = new Writer();
    const newest = limit();
    let count = 0;
    let upto = client.upto;
    while (client.index < order.length && count < (client.origins ? 300 : 460)) {
      const key = order[client.index];
      const at = playback ? client.index + 1 : changedAt.get(key);
      if (at > newest) break;
      client.index++;
      // Older states of a block that changed again are not sent: the newest comes later.
      if (!playback && order[client.index - 1] !== undefined && client.index - 1 < at - 1 && order[at - 1] === key && at !== client.index) continue;
      const [x, y, z] = key.split(",").map(Number);
      w.i32(x).i32(y).i32(z).raw(world.blocks.get(key));
      if (client.origins) origins(w, x, world.blocks.get(key));
      count++;
      upto = at;
    }
    if (client.index >= order.length || upto > newest) upto = newest;
    if (playback && client.index >= newest) upto = newest;
    client.upto = upto;
    const head = new Writer().u64(upto).u64(Math.max(newest, upto)).u64(now()).u8(client.origins ? 1 : 0).u32(count);
    return { bytes: new Writer().raw(Buffer.concat(head.parts)).raw(Buffer.concat(w.parts)).frame(2), count };
  }

  function origins(w, x, planes) {
    if (x !== 0 || robots.length < 2) return w.u16(1).u16(robots[(((x >> 4) % robots.length) + robots.length) % robots.length].id);
    const known = Uint8Array.from({ length: 64 }, (_, i) => planes[i] | planes[64 + i]);
    const [left, right] = [known.map((b) => b & 0x0f), known.map((b) => b & 0xf0)];
    if (left.every((b) => b === 0) || right.every((b) => b === 0)) return w.u16(1).u16(1);
    return w.u16(2).u16(1).raw(left).u16(2).raw(right);
  }

  function poses(robot) {
    const w = new Writer().u16(robots.length);
    for (const other of robots) {
      const p = pose(other, time());
      const own = other === robot;
      w.u16(other.id).u64(other.epoch).f64(p.at[0]).f64(p.at[1]).f64(p.at[2]).u8(own ? 1 : 0);
      for (const q of p.turned) w.f64(own ? q : 0);
      w.u64(other.silentSince ? 1000 * (Date.now() - other.silentSince) : 40_000);
    }
    return w.frame(4);
  }

  function counters(robot) {
    return new Writer().u64(now()).u16(5)
      .text("node_bytes_out").u64(robot.out).text("node_bytes_in").u64(robot.in)
      .text("node_datagrams_out").u64(robot.datagrams).text("node_datagrams_in").u64(robot.datagrams)
      .text("node_frames").u64(12).frame(5);
  }

  function links(robot) {
    const others = robots.filter((other) => other !== robot);
    const w = new Writer().u16(others.length);
    for (const other of others) {
      w.u16(other.id).u64(other.epoch).u8(3).u32(31_000 + 1000 * other.id).u32(Math.round(65_536 * (0.12 + 0.05 * other.id)))
        .u64(other.out).u64(robot.out).u32(other.id % 2 ? 0 : 3).u32(1).u64(90_000);
    }
    return w.frame(7);
  }

  function scan(robot) {
    const { at, turned } = pose(robot, time());
    const points = [];
    const heading = 2 * Math.atan2(turned[2], turned[3]);
    for (let i = 0; i < 700; i++) {
      const [a, b] = [i * 2.399963, Math.asin(((i / 700) * 2 - 1) * 0.7) - 0.25];
      const d = [Math.cos(b) * Math.cos(a + heading), Math.cos(b) * Math.sin(a + heading), Math.sin(b)];
      for (let r = 0.5; r < 20; r += 0.1) {
        const p = d.map((c, k) => Math.floor((at[k] + r * c) / VOXEL));
        if (world.get(...p) !== 2) continue;
        points.push([r * Math.cos(b) * Math.cos(a), r * Math.cos(b) * Math.sin(a), r * Math.sin(b)]);
        break;
      }
    }
    const w = new Writer().u64(now());
    for (const v of [...at, ...turned]) w.f64(v);
    w.u32(20_000).u32(points.length);
    for (const p of points) for (const c of p) w.f32(c);
    return w.frame(8);
  }

  /** Each robot has two submaps, the second of which lies otherwise after a loop was closed. */
  function submaps() {
    const w = new Writer().u16(robots.length);
    for (const { id, epoch, lift } of robots) {
      w.u16(id).u64(epoch).u16(1).u16(0).u16(2);
      for (const [submap, z] of [[0, 0], [1, lift ?? 0]]) {
        w.u16(submap);
        for (const v of [0, 0, z, 0, 0, 0, 1]) w.f64(v);
      }
    }
    return w.frame(10);
  }

  function shownPlayback() {
    return new Writer().u64(zero).u64(zero + SECONDS * 1e6).u64(now()).f32(playback.speed).u8(playback.plays ? 1 : 0).frame(9);
  }

  function series(robot) {
    const rows = [];
    const first = playback ? 0 : 20;
    for (let s = first; s < (playback ? SECONDS : Math.floor((now() - zero) / 1e6)); s++) {
      const wave = 1 + 0.4 * Math.sin(s / 9 + robot.id) + 0.15 * Math.sin(s * 1.7);
      rows.push([Math.round(2_900 * wave), Math.round(3_100 * wave), Math.round(9_100 * wave), s % 40 === 39 ? null : Math.round(93_000 * wave)]);
    }
    const names = ["sent", "received", "paper", "racer"];
    return { begin_us: zero + first * 1e6, step_s: 1, names, bytes: names.map((_, i) => rows.map((row) => row[i])) };
  }

  const server = createServer(async (request, response) => {
    const url = new URL(request.url, "http://x");
    response.setHeader("Content-Security-Policy", CSP);
    const json = (value) => {
      response.setHeader("Content-Type", "application/json");
      response.end(JSON.stringify(value));
    };
    if (types[url.pathname]) {
      response.setHeader("Content-Type", types[url.pathname]);
      return response.end(await readFile(assets + (url.pathname === "/" ? "index.html" : url.pathname.slice(1))));
    }
    if (options.token && url.searchParams.get("token") !== options.token) {
      response.statusCode = 401;
      return response.end("token?");
    }
    if (url.pathname === "/robots") {
      return json({ title: playback ? "replay: forest" : "mock: forest", kind: playback ? "playback" : "live", robots: robots.map(({ id, name }) => ({ id, name })) });
    }
    const robot = robots.find((r) => url.pathname === `/series/${r.id}`);
    if (robot) return json(series(robot));
    response.statusCode = 404;
    response.end();
  });

  const sockets = new WebSocketServer({ noServer: true });
  server.on("upgrade", (request, socket, head) => {
    const url = new URL(request.url, "http://x");
    const robot = robots.find((r) => url.pathname === `/feed/${r.id}`);
    if (!robot || (options.token && url.searchParams.get("token") !== options.token)) return socket.destroy();
    sockets.handleUpgrade(request, socket, head, (ws) => serve(ws, robot));
  });

  function serve(ws, robot) {
    let asked = Buffer.alloc(0);
    let client = null;
    ws.on("message", (data, binary) => {
      if (!binary) return command(JSON.parse(data.toString()));
      asked = Buffer.concat([asked, data]);
      if (client || asked.length < 35) return;
      const flags = asked[10];
      const have = { feed: asked.readBigUInt64LE(11), upto: Number(asked.readBigUInt64LE(27)) };
      const map = (flags & 2) === 0;
      const goesOn = map && !playback && have.feed === BigInt(feedId) && have.upto > 0 && !(flags & 1);
      client = { ws, robot, map, origins: (flags & 1) !== 0, links: (flags & 4) !== 0, scans: (flags & 8) !== 0, submaps: (flags & 16) !== 0, upto: goesOn ? have.upto : 0, index: goesOn ? have.upto : 0, first: true };
      clients.add(client);
      const hello = new Writer().raw("FLKM").u8(1).u8((client.origins ? 1 : 0) | (goesOn ? 2 : 0)).u16(robot.id).u32(VOXEL * 1e6).u64(feedId).text(robot.name).text("map");
      send(client, hello.frame(1));
      if (map && !goesOn) send(client, new Writer().u64(limit()).frame(3));
      if (playback) send(client, shownPlayback());
      if (client.submaps) send(client, submaps());
    });
    ws.on("close", () => clients.delete(client));
  }

  function send(client, bytes) {
    if (control.stalled) return;
    // Cut where it hurts: a frame begins in one message and ends in the next.
    const cut = Math.min(bytes.length, 1 + (bytes.length % 7));
    client.ws.send(bytes.subarray(0, cut));
    for (let from = cut; from < bytes.length; from += 65_536) client.ws.send(bytes.subarray(from, from + 65_536));
  }

  function anew() {
    for (const client of clients) {
      if (!client.map) continue;
      [client.upto, client.index, client.first] = [0, 0, true];
      send(client, new Writer().u64(limit()).frame(3));
    }
  }

  function command(c) {
    if (!playback) return;
    if (typeof c.seek_us === "number") {
      const at = Math.max(0, Math.min(SECONDS, (c.seek_us - zero) / 1e6));
      const back = at < playback.at;
      playback.at = at;
      if (back) anew();
    }
    if (typeof c.play === "boolean") playback.plays = c.play;
    if (typeof c.speed === "number") playback.speed = Math.max(0.1, Math.min(100, c.speed));
    for (const client of clients) {
      send(client, shownPlayback());
      send(client, poses(client.robot));
    }
  }

  let tick = 0;
  let spot = 0;
  const timer = setInterval(() => {
    tick++;
    if (playback?.plays) {
      playback.at = Math.min(SECONDS, playback.at + 0.05 * playback.speed);
      if (playback.at >= SECONDS) playback.plays = false;
    }
    if (!playback && !options.still && tick % 4 === 0) {
      // A box that walks: what it leaves is free again.
      const box = (n, state) => {
        const [x0, y0] = [Math.round(60 * Math.cos(n / 20)), Math.round(60 * Math.sin(n / 20))];
        const keys = new Set();
        for (let z = 0; z < 8; z++) for (let y = 0; y < 5; y++) for (let x = 0; x < 5; x++) keys.add(world.set(x0 + x, y0 + y, ground(x0, y0) + 14 + z, state));
        keys.forEach(change);
      };
      box(spot, 1);
      box(++spot, 2);
    }
    for (const robot of robots) {
      if (tick % 20 === robot.id) {
        robot.out += Math.round(2_600 + 900 * Math.sin(tick / 90 + robot.id));
        robot.in += 2_800;
        robot.datagrams += 5;
      }
    }
    for (const client of clients) {
      if (client.ws.bufferedAmount > 1 << 20) continue;
      const { robot } = client;
      if (client.map) {
        for (let i = 0; i < (control.slow ? 1 : 40); i++) {
          if (!client.first && client.upto >= limit()) break;
          client.first = false;
          if (control.slow && tick % control.slow !== 0) break;
          send(client, blocks(client).bytes);
        }
      }
      if (!robot.silentSince && (tick % 2 === 0) && (!playback || playback.plays || tick % 20 === 0)) send(client, poses(robot));
      if (tick % 20 === 0) {
        send(client, counters(robot));
        if (client.links) send(client, links(robot));
        if (playback) send(client, shownPlayback());
      }
      if (client.scans && tick % 4 === 0) send(client, scan(robot));
      if (playback?.plays && tick % 5 === 0) send(client, shownPlayback());
      // A kind that no reader knows yet.
      if (tick % 40 === 0) send(client, new Writer().raw("from later").frame(200));
    }
  }, 50);

  await new Promise((resolve) => server.listen(options.port ?? 0, "127.0.0.1", resolve));
  return {
    world,
    robots,
    port: server.address().port,
    url: `http://127.0.0.1:${server.address().port}/`,
    control,
    cut: () => [...clients].forEach(({ ws }) => ws.terminate()),
    damage: () => [...clients].filter((c) => c.map).forEach((c) => c.ws.send(Buffer.from([0xff, 0xff, 0xff, 0xff, 2]))),
    end: (why) => [...clients].forEach((c) => (send(c, new Writer().raw(why).frame(6)), c.ws.close())),
    /** The node starts again: another feed. */
    restart: () => (feedId++, [...clients].forEach(({ ws }) => ws.terminate())),
    anew,
    /** A loop of a robot is closed: its newest submap lies so much higher now. */
    closeLoop: (robot, lift) => {
      robot.lift = lift;
      for (const client of clients) if (client.submaps) send(client, submaps());
    },
    change: (x, y, z, state) => change(world.set(x, y, z, state)),
    close: () => {
      clearInterval(timer);
      [...clients].forEach(({ ws }) => ws.terminate());
      server.closeAllConnections();
      server.close();
    },
  };
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const { values } = parseArgs({
    options: { port: { type: "string", default: "8080" }, side: { type: "string", default: "400" }, robots: { type: "string", default: "3" }, playback: { type: "boolean" }, still: { type: "boolean" } },
  });
  const mock = await start({ port: Number(values.port), side: Number(values.side), robots: Number(values.robots), playback: values.playback, still: values.still });
  console.log(mock.url);
}
