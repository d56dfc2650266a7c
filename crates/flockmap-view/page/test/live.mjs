// The page against the program: two nodes map a simulated flight and send each other their maps over a radio that loses datagrams. A browser
// follows the first, its connection is cut once, and at rest it must have, block by block, what `flockmap mirror` has of that node.
//
// usage: FLOCKMAP=path node test/live.mjs    environment: LIVE_SECONDS=120, LOSS=0.2, CHROMIUM, SHOTS=folder for a picture

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, openSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { cable } from "./cable.mjs";
import { launch, naiveFaces, ownPage, state, until } from "./chromium.mjs";

const { FLOCKMAP, SHOTS } = process.env;
const [SECONDS, LOSS] = [Number(process.env.LIVE_SECONDS ?? 120), process.env.LOSS ?? "0.2"];
if (!FLOCKMAP) throw new Error("FLOCKMAP must say where the program is");
const folder = mkdtempSync(join(tmpdir(), "flockmap-live-"));
const base = 20_000 + 100 * (process.pid % 120);
const at = (offset) => `127.0.0.1:${base + offset}`;
const children = [];

function run(name, ...args) {
  const log = openSync(join(folder, `${name}.log`), "w");
  const child = spawn(FLOCKMAP, args, { cwd: folder, stdio: ["ignore", log, log] });
  children.push(child);
  child.ended = new Promise((resolve) => child.on("exit", resolve));
  return child;
}

/** Voxels by their blocks, of a .ply of `flockmap mirror`. */
function readMap(path, voxel) {
  const bytes = readFileSync(path);
  const head = bytes.indexOf("end_header\n") + 11;
  const header = bytes.subarray(0, head).toString();
  assert.deepEqual(header.match(/property .*/g), ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue", "uchar state"].map((p) => `property ${p}`));
  const count = Number(/element vertex (\d+)/.exec(header)[1]);
  assert.equal(bytes.length, head + 16 * count);
  const blocks = new Map();
  for (let i = head; i < bytes.length; i += 16) {
    const place = [0, 4, 8].map((axis) => Math.floor(bytes.readFloatLE(i + axis) / voxel));
    const key = place.map((v) => v >> 3).join();
    const index = place.reduceRight((sum, v) => 8 * sum + (v & 7), 0);
    let block = blocks.get(key);
    if (!block) blocks.set(key, (block = new Uint8Array(512)));
    // In the file 0 is free and 1 is occupied; here 0 is unknown.
    block[index] = bytes[i + 15] + 1;
  }
  return blocks;
}

let browser;
try {
  execFileSync(FLOCKMAP, ["sim", "fly", "--seconds", String(SECONDS), "--robots", "2", "--no-view", "--out", folder], { stdio: "ignore" });
  for (const n of [1, 2]) {
    const outputs = n === 1 ? `[map_output]\nlisten_tcp = "${at(10)}"\n[view]\nlisten = "${at(11)}"\n` : "";
    writeFileSync(
      join(folder, `${n}.toml`),
      `id = ${n}\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[state]\npath = "state${n}"\n[network]\nbind = "${at(n)}"\npeers = ["${at(5 - n)}"]\n` +
        `[sensor]\nrecord = "robot${n}.mcap"\n${outputs}`,
    );
  }
  // Node n hears what comes to base + n, and sends to the radio.
  run("radio", "radio", at(1), at(2), "--listen", at(3), "--loss", LOSS);
  const nodes = [1, 2].map((n) => run(`node${n}`, "node", "--config", `${n}.toml`));
  const wire = cable(base + 12, base + 11);
  browser = await launch();
  const page = await (await browser.newContext({ viewport: { width: 1_600, height: 1_000 }, colorScheme: "light", reducedMotion: "reduce" })).newPage();
  const errors = [];
  page.on("pageerror", (error) => errors.push(error.stack));
  await ownPage(page);
  for (let tries = 0; ; tries++) {
    const answers = await fetch(`http://${at(11)}/robots`).then((answer) => answer.ok, () => false);
    if (answers) break;
    assert.ok(tries < 100, "the node serves its page within 10 s");
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  await page.goto(`http://${at(12)}/`);
  await until(page, "the first map", async () => (await state(page))?.complete);

  const begun = Date.now();
  let [cut, back, before, samples, behind] = [0, null, 0, 0, 0];
  while (Date.now() - begun < 1e3 * SECONDS) {
    await page.waitForTimeout(1_000);
    const s = await state(page);
    samples++;
    if (s.upto !== s.newest) behind++;
    // After the cut it goes on from what it had, and does not begin anew.
    assert.ok(Number(s.upto) >= before, `the map went back from version ${before} to ${s.upto}`);
    before = Number(s.upto);
    if (cut && back === null && s.connected) back = Date.now() - cut;
    if (!cut && Date.now() - begun > 500 * SECONDS) {
      wire.pull();
      cut = Date.now();
      await until(page, "the cut is noticed", async () => !(await state(page)).connected, 5);
    }
  }
  assert.ok(back !== null, "the page came back after the cut");
  // At rest: nothing has come for five seconds.
  let last = "";
  let since = Date.now();
  const rest = await until(page, "rest", async () => {
    const s = await state(page);
    if (s.upto !== last) [last, since] = [s.upto, Date.now()];
    return Date.now() - since > 5_000 && s.upto === s.newest && s.pendingMeshes === 0 && s;
  }, 120);

  execFileSync(FLOCKMAP, ["mirror", at(10), "--once", "--free", "--out", join(folder, "truth.ply")], { stdio: "ignore" });
  const truth = readMap(join(folder, "truth.ply"), 0.1);
  const seen = new Map((await page.evaluate(() => window.flockmap.blocks())).map(([x, y, z, free, occupied]) => [`${x},${y},${z}`, [free, occupied].join()]));
  assert.equal((await state(page)).upto, rest.upto, "the map changed while it was compared");
  let differ = 0;
  const total = [0, 0];
  for (const [key, block] of truth) {
    const counts = [1, 2].map((is) => block.reduce((n, voxel) => n + (voxel === is ? 1 : 0), 0));
    counts.forEach((n, i) => (total[i] += n));
    if (seen.get(key) !== counts.join()) differ++;
  }
  for (const key of seen.keys()) if (!truth.has(key)) differ++;
  console.log(
    `  ${SECONDS} s at ${100 * LOSS} % loss: ${truth.size} blocks, ${total[0]} free and ${total[1]} occupied voxels; blocks that differ: ${differ}\n` +
      `  cut once, connected again after ${(back / 1e3).toFixed(1)} s, went on from its version; newer was known than shown in ${behind} of ${samples} looks`,
  );
  assert.equal(differ, 0);

  const occupied = (x, y, z) => truth.get([x >> 3, y >> 3, z >> 3].join())?.[(((z & 7) << 6) | ((y & 7) << 3)) + (x & 7)] === 2;
  const faces = await until(page, "nodes of level 0", async () => {
    const list = await page.evaluate(() => window.flockmap.faces());
    return list.length > 0 && list;
  });
  let wrong = 0;
  for (const node of faces) if (node.faces !== naiveFaces(occupied, node)) wrong++;
  console.log(`  ${faces.length} meshes of level 0, ${faces.reduce((n, node) => n + node.faces, 0)} faces; meshes that differ from a count voxel by voxel: ${wrong}`);
  assert.equal(wrong, 0);
  if (SHOTS) {
    mkdirSync(SHOTS, { recursive: true });
    await page.screenshot({ path: join(SHOTS, "live.png"), timeout: 120_000 });
  }
  assert.deepEqual(errors, []);
  for (const node of nodes) node.kill("SIGINT");
  await Promise.all(nodes.map((node) => node.ended));
  wire.close();
  console.log("ok: the page has what the node has");
} finally {
  await browser?.close();
  for (const child of children) child.kill("SIGKILL");
  rmSync(folder, { recursive: true, force: true });
}
