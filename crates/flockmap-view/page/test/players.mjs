// The page with a recording of the program: each connection has a player of its own there, and all must show the time of the page, also after
// they broke or when another robot is chosen.
//
// usage: FLOCKMAP=path node test/players.mjs    environment: CHROMIUM

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { cable } from "./cable.mjs";
import { launch, ownPage, state, until } from "./chromium.mjs";

const { FLOCKMAP } = process.env;
if (!FLOCKMAP) throw new Error("FLOCKMAP must say where the program is");
const port = 20_000 + (process.pid % 10_000);
const folder = mkdtempSync(join(tmpdir(), "flockmap-players-"));
const program = spawn(FLOCKMAP, ["replay", "forest", "--seconds", "20", "--loss", "0.2", `--view=127.0.0.1:${port}`], { cwd: folder, stdio: "ignore" });
const browser = await launch();
try {
  const wire = cable(port + 1, port);
  const page = await (await browser.newContext({ viewport: { width: 1_200, height: 800 }, reducedMotion: "reduce" })).newPage();
  const errors = [];
  page.on("pageerror", (error) => errors.push(error.stack));
  await ownPage(page);
  await until(page, "the page is served", () => page.goto(`http://127.0.0.1:${port + 1}/`).then(() => true, () => false));
  await until(page, "the flight is whole", async () => (await state(page))?.playback?.grows === false, 120);
  const shows = (second, plays) => (s) => s.playback.plays === plays && Math.abs(s.playback.at - s.playback.begin - second) < 0.2 && s.connected && s.upto === s.newest;
  const stands = (what, second) => until(page, what, async () => ((s) => shows(second, false)(s) && s)(await state(page)), 20);

  if ((await state(page)).playback.plays) await page.locator("#play").click();
  await page.locator("#scrub").fill("12");
  await stands("12 s are shown", 12);
  await page.waitForTimeout(1_500);
  const { occupied, free } = await stands("12 s are still shown", 12);
  assert.ok(occupied > 0);
  for (let n = 0; n < 2; n++) {
    wire.pull();
    await until(page, "the cut is noticed", async () => !(await state(page)).connected, 5);
    await stands("12 s after the cut", 12);
    await until(page, "the map of 12 s", async () => ((s) => s.occupied === occupied && s.free === free)(await state(page)), 20);
  }
  await page.keyboard.press("2");
  await until(page, "the map of robot 2 at 12 s", async () => ((s) => s.robot === 2 && s.complete && shows(12, false)(s))(await state(page)), 20);
  await page.keyboard.press("1");
  await until(page, "the map of robot 1 at 12 s", async () => ((s) => s.robot === 1 && s.occupied === occupied && s.free === free)(await state(page)), 20);
  await page.locator("#speed").selectOption("4");
  await page.locator("#play").click();
  await until(page, "the end", async () => ((s) => !s.playback.plays && s.playback.end - s.playback.at < 0.1)(await state(page)), 20);
  await page.locator("#play").click();
  await until(page, "it begins again", async () => ((s) => s.playback.plays && s.playback.at - s.playback.begin < 15)(await state(page)), 10);
  assert.deepEqual(errors, []);
  wire.close();
  console.log("ok: every player shows the time of the page, after cuts and with another robot");
} finally {
  await browser.close();
  program.kill("SIGINT");
  rmSync(folder, { recursive: true, force: true });
}
