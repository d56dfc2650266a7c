// What a map costs the page: frames a second while the picture turns, draw calls, triangles, memory; and a picture to look at.
//
// usage: FLOCKMAP=path node test/figures.mjs OUT.png ARGUMENT...
//   ARGUMENTs are flockmap's, without where it listens:  hku.png replay robot1.mcap robot2.mcap   plan.png view map.bt
// environment: WAIT=600, seconds until all of it is there; WIDE=1600; HIGH=1000; SCHEME=dark; CHROMIUM; OWN=1, the page of this folder

import { spawn } from "node:child_process";
import { existsSync, mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { launch, ownPage, state, until } from "./chromium.mjs";

const { FLOCKMAP, WAIT = "600", WIDE = "1600", HIGH = "1000", SCHEME = "dark", OWN } = process.env;
const [out, command, ...rest] = process.argv.slice(2);
if (!FLOCKMAP || !command) throw new Error("usage: FLOCKMAP=path node test/figures.mjs OUT.png ARGUMENT...");
const address = `127.0.0.1:${20_000 + (process.pid % 10_000)}`;
const listens = command === "view" ? ["--listen", address] : [`--view=${address}`];
const folder = mkdtempSync(join(tmpdir(), "flockmap-figures-"));
const files = rest.map((argument) => (existsSync(argument) ? resolve(argument) : argument));
const program = spawn(resolve(FLOCKMAP), [command, ...files, ...listens], { cwd: folder, stdio: "ignore" });
const browser = await launch();
try {
  const page = await (await browser.newContext({ viewport: { width: +WIDE, height: +HIGH }, colorScheme: SCHEME })).newPage();
  const errors = [];
  page.on("pageerror", (error) => errors.push(error.stack));
  if (OWN) await ownPage(page);
  await until(page, "the page is served", () => page.goto(`http://${address}/`).then(() => true, () => false), 60);
  await until(page, "all is there", async () => {
    const s = await state(page);
    return s?.complete && !s.playback?.grows;
  }, +WAIT);
  if ((await state(page)).playback) {
    await page.locator("#scrub").evaluate((scrub) => {
      scrub.value = scrub.max;
      scrub.dispatchEvent(new Event("input"));
    });
    await page.waitForTimeout(2_000);
  }
  await page.getByRole("button", { name: "Whole map" }).click();
  const drawn = () => until(page, "all is drawn", async () => {
    const s = await state(page);
    return s.upto === s.newest && s.pendingMeshes === 0 && s;
  }, 120);
  await drawn();
  const [x, y] = [+WIDE / 2, +HIGH / 2];
  const looks = [];
  await page.mouse.move(x, y);
  await page.mouse.down();
  for (let i = 0; i < 60; i++) {
    await page.mouse.move(x + 6 * (i % 30), y + (i % 7));
    await page.waitForTimeout(100);
    looks.push(await state(page));
  }
  await page.mouse.up();
  const fps = looks.map((s) => s.fps).sort((a, b) => a - b);
  const most = (name) => Math.max(...looks.map((s) => s[name]));
  await page.waitForTimeout(1_000);
  const s = await drawn();
  await page.waitForTimeout(3_000);
  const heap = await page.evaluate(() => performance.memory.usedJSHeapSize);
  const mb = (bytes) => `${(bytes / 1e6).toFixed(1)} MB`;
  console.log(
    `${out}: ${s.occupied} occupied voxels, ${WIDE} × ${HIGH}; turning: ${fps[30].toFixed(1)} frames a second (median of 60 looks), at most ` +
      `${most("drawCalls")} draw calls, ${most("triangles")} triangles; heap ${mb(heap)}, blocks ${mb(s.mapBytes)}, meshes ${mb(s.meshBytes)}`,
  );
  await page.screenshot({ path: out, timeout: 120_000 });
  if (errors.length) throw new Error(errors.join("\n"));
} finally {
  await browser.close();
  program.kill("SIGINT");
  rmSync(folder, { recursive: true, force: true });
}
