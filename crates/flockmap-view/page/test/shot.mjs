// The picture of the README: the page as it shows a flight through the forest, each voxel in the colour of the robot that saw it last.
//
// usage: FLOCKMAP=path node test/shot.mjs OUT.jpg    environment: AT=40, second of the flight; CHROMIUM; OWN=1, the page of this folder
//   in the place of the one that the program has

import { spawn } from "node:child_process";
import { mkdtempSync, rmSync, statSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { launch, ownPage, state, until } from "./chromium.mjs";

const [{ FLOCKMAP, AT = "40", OWN }, out] = [process.env, process.argv[2]];
if (!FLOCKMAP || !out) throw new Error("usage: FLOCKMAP=path node test/shot.mjs OUT.jpg");
const BYTES_MAX = 250_000;
const address = `127.0.0.1:${20_000 + (process.pid % 10_000)}`;
const folder = mkdtempSync(join(tmpdir(), "flockmap-shot-"));
const program = spawn(FLOCKMAP, ["replay", "forest", "--loss", "0.2", `--view=${address}`], { cwd: folder, stdio: "ignore" });
const browser = await launch();
try {
  const page = await (await browser.newContext({ viewport: { width: 1_600, height: 900 }, colorScheme: "light", reducedMotion: "reduce" })).newPage();
  if (OWN) await ownPage(page);
  await until(page, "the page is served", () => page.goto(`http://${address}/`).then(() => true, () => false), 60);
  const end = await until(page, "the flight is whole", async () => {
    const playback = (await state(page))?.playback;
    return playback && !playback.grows && playback.end - playback.begin;
  }, 120);
  // Playing from a little before, so that robots have trails.
  const second = Math.min(Number(AT), end - 1);
  await page.locator("#scrub").fill(String(Math.max(0, second - 15)));
  await until(page, "the time before it", async () => {
    const { playback } = await state(page);
    return playback.at - playback.begin < second - 5;
  });
  await page.getByRole("radio", { name: "Robot", exact: true }).check();
  if (!(await state(page)).playback.plays) await page.locator("#play").click();
  await until(page, "the moment", async () => {
    const { playback } = await state(page);
    return playback.at - playback.begin >= second;
  }, 60);
  await page.locator("#play").click();
  await page.getByRole("button", { name: "Whole map" }).click();
  await page.waitForTimeout(2_000);
  await until(page, "all is drawn", async () => {
    const s = await state(page);
    return s.upto === s.newest && s.pendingMeshes === 0;
  });
  await page.waitForTimeout(3_000);
  for (let quality = 88; quality >= 40; quality -= 8) {
    await page.screenshot({ path: out, type: "jpeg", quality, timeout: 120_000 });
    if (statSync(out).size <= BYTES_MAX) break;
  }
  const bytes = statSync(out).size;
  console.log(`${out}: 1600 × 900, ${bytes} bytes`);
  if (bytes > BYTES_MAX) throw new Error(`more than ${BYTES_MAX} bytes`);
} finally {
  await browser.close();
  program.kill("SIGINT");
  rmSync(folder, { recursive: true, force: true });
}
