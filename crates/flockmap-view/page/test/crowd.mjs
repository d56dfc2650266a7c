// What browsers cost a node: its processor time and its memory while it maps a simulated flight, beside none, one that follows, one that
// is slow, one that is stuck, and a thousand that come at once. Each case is a flight of its own, with the same robots.
//
// usage: FLOCKMAP=path node test/crowd.mjs    environment: CROWD_SECONDS=40, CASES=none,follows,slow,stuck,thousand

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdtempSync, openSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { connect } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";

const { FLOCKMAP, CROWD_SECONDS = "40", CASES = "none,follows,slow,stuck,thousand" } = process.env;
if (!FLOCKMAP) throw new Error("FLOCKMAP must say where the program is");
const SLOW = 10_000;
const folder = mkdtempSync(join(tmpdir(), "flockmap-crowd-"));
const base = 20_000 + 100 * (process.pid % 120);
const at = (offset) => `127.0.0.1:${base + offset}`;
const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** A hello for all of the map, as a masked WebSocket message. */
const hello = (() => {
  const body = Buffer.alloc(30);
  body.write("FLKM");
  body[4] = 1;
  const frame = Buffer.alloc(5);
  frame.writeUInt32LE(1 + body.length);
  frame[4] = 1;
  return Buffer.concat([frame, body]);
})();

/** A browser's connection; `taken` says how many bytes it has taken. */
function browser(rate) {
  const socket = connect({ port: base + 11, host: "127.0.0.1", highWaterMark: 4_096 });
  const client = { socket, taken: 0, over: false };
  socket.on("error", () => {}).on("close", () => (client.over = true));
  socket.write(
    `GET /feed/1 HTTP/1.1\r\nHost: ${at(11)}\r\nOrigin: http://${at(11)}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n` +
      "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n",
  );
  socket.write(Buffer.concat([Buffer.from([0x82, 0x80 | hello.length, 0, 0, 0, 0]), hello]));
  if (rate === 0) return client;
  if (rate === Infinity) socket.on("data", (bytes) => (client.taken += bytes.length));
  else {
    const timer = setInterval(() => {
      const bytes = socket.read(Math.min(rate / 10, socket.readableLength));
      if (bytes) client.taken += bytes.length;
    }, 100);
    socket.on("close", () => clearInterval(timer));
  }
  return client;
}

const ticks = (pid) => readFileSync(`/proc/${pid}/stat`, "utf8").split(") ")[1].split(" ").slice(11, 13).reduce((sum, n) => sum + Number(n), 0) / 100;
const resident = (pid, name) => Number(new RegExp(`${name}:\\s+(\\d+)`).exec(readFileSync(`/proc/${pid}/status`, "utf8"))[1]) / 1024;

async function fly(name) {
  const children = [];
  const run = (label, ...args) => {
    const log = openSync(join(folder, `${label}.log`), "w");
    children.push(spawn(FLOCKMAP, args, { cwd: folder, stdio: ["ignore", log, log] }));
    return children.at(-1);
  };
  try {
    for (const n of [1, 2]) rmSync(join(folder, `state${n}`), { recursive: true, force: true });
    run("radio", "radio", at(1), at(2), "--listen", at(3), "--loss", "0.2");
    const [node] = [1, 2].map((n) => run(`node${n}`, "node", "--config", `${n}.toml`));
    const end = Date.now() + 1e3 * Number(CROWD_SECONDS);
    let answers = false;
    for (let i = 0; i < 100 && !answers; i++) {
      await wait(100);
      answers = await fetch(`http://${at(11)}/robots`).then((answer) => answer.ok, () => false);
    }
    assert.ok(answers, readFileSync(join(folder, "node1.log"), "utf8"));
    const rates = { none: [], follows: [Infinity], slow: [SLOW], stuck: [0], thousand: Array(1_000).fill(Infinity) }[name];
    const clients = rates.map(browser);
    let most = 0;
    while (Date.now() < end) {
      await wait(200);
      most = Math.max(most, resident(node.pid, "VmRSS"));
    }
    const left = clients.filter((client) => !client.over);
    const taken = clients.reduce((sum, client) => sum + client.taken, 0);
    const metrics = await fetch(`http://${at(11)}/metrics`).then((answer) => answer.text(), () => "");
    const count = (counter) => new RegExp(`^flockmap_${counter}\\S* (\\S+)$`, "m").exec(metrics)?.[1] ?? "?";
    console.log(
      `  ${name}: processor ${ticks(node.pid).toFixed(2)} s of ${CROWD_SECONDS}, at most ${most.toFixed(1)} MiB resident, ` +
        `${left.length} of ${clients.length} connected at the end, ${(taken / 1e6).toFixed(2)} MB taken; ${count("node_frames")} scans mapped`,
    );
    clients.forEach((client) => client.socket.destroy());
  } finally {
    for (const child of children) child.kill("SIGKILL");
    await Promise.all(children.map((child) => child.exitCode ?? new Promise((resolve) => child.on("exit", resolve))));
  }
}

try {
  execFileSync(FLOCKMAP, ["sim", "fly", "--seconds", CROWD_SECONDS, "--robots", "2", "--no-view", "--out", folder], { stdio: "ignore" });
  for (const n of [1, 2]) {
    writeFileSync(
      join(folder, `${n}.toml`),
      `id = ${n}\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[state]\npath = "state${n}"\n[network]\nbind = "${at(n)}"\npeers = ["${at(5 - n)}"]\n` +
        `[sensor]\nrecord = "robot${n}.mcap"\n${n === 1 ? `[view]\nlisten = "${at(11)}"\n` : ""}`,
    );
  }
  for (const name of CASES.split(",")) await fly(name);
} finally {
  rmSync(folder, { recursive: true, force: true });
}
