// The page in Chromium, without a graphics card, against the made-up server: clicks through all of it and looks what it says.
//
// usage: node test/browser.mjs    environment: CHROMIUM=/usr/bin/chromium, SHOTS=folder for pictures, ONLY=part of a name

import assert from "node:assert/strict";
import { mkdirSync } from "node:fs";
import { launch, naiveFaces, state, until } from "./chromium.mjs";
import { start } from "./mock.mjs";
import { forest, tally } from "./world.mjs";

const SHOTS = process.env.SHOTS;
if (SHOTS) mkdirSync(SHOTS, { recursive: true });
const browser = await launch();

const whole = (page, more = () => true) =>
  until(page, "the map is there and drawn", async () => {
    const s = await state(page);
    return s?.complete && s.pendingMeshes === 0 && s.faces > 0 && s.drawCalls > 0 && more(s) && s;
  });

const says = (page, selector, pattern, seconds = 30) =>
  until(page, `${selector} says ${pattern}`, async () => pattern.test((await page.locator(selector).textContent()) ?? ""), seconds);

async function open(mock, { width = 1_600, height = 1_000, theme = "light", touch = false, hash = "" } = {}) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme, hasTouch: touch, reducedMotion: "reduce" });
  const page = await context.newPage();
  const errors = [];
  // What the browser says of a connection that the test itself cut is no error of the page.
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type()) && !/WebSocket connection to|ERR_CONNECTION|GPU stall|401 \(/.test(message.text())) errors.push(message.text());
  });
  page.on("pageerror", (error) => errors.push(error.stack));
  await page.goto(mock.url + hash);
  return { page, close: async () => (await context.close(), assert.deepEqual(errors, [])) };
}

async function shot(page, name) {
  if (SHOTS) await page.screenshot({ path: `${SHOTS}/${name}.png`, timeout: 120_000 });
}

/** What the mirror has, block by block, against the world of the server. */
async function same(page, mock) {
  const ones = (planes) => planes.reduce((n, b) => n + b.toString(2).replaceAll("0", "").length, 0);
  const want = new Map([...mock.world.blocks].map(([key, p]) => [key, [ones(p.subarray(0, 64)), ones(p.subarray(64))].join()]));
  const got = new Map((await page.evaluate(() => window.flockmap.blocks())).map(([x, y, z, free, occupied]) => [`${x},${y},${z}`, `${free},${occupied}`]));
  for (const [key, counts] of want) if (counts !== "0,0") assert.equal(got.get(key), counts, `block ${key}`);
  for (const key of got.keys()) assert.ok(want.has(key), `block ${key} is not in the map`);
}

/** Two fingers around a place go from one distance of it to another. */
async function pinch(page, x, y, from, to) {
  const devtools = await page.context().newCDPSession(page);
  const touch = (type, far) => devtools.send("Input.dispatchTouchEvent", { type, touchPoints: far === null ? [] : [{ x: x - far, y, id: 0 }, { x: x + far, y, id: 1 }] });
  await touch("touchStart", from);
  for (let i = 1; i <= 5; i++) await touch("touchMove", from + ((to - from) * i) / 5);
  await touch("touchEnd", null);
}

const parts = {
  async "a map that stands still: what is shown is what is there"() {
    const mock = await start({ side: 160, robots: 2, still: true });
    const { page, close } = await open(mock);
    const s = await whole(page);
    const { occupied, free } = tally(mock.world);
    assert.deepEqual([s.occupied, s.free], [occupied, free]);
    assert.equal(s.upto, s.newest);
    await same(page, mock);
    // Near enough for the finest level.
    await page.getByRole("button", { name: "Follow robot1" }).click();
    const nodes = await until(page, "nodes of level 0", async () => {
      const list = await page.evaluate(() => window.flockmap.faces());
      return list.length > 0 && list;
    });
    for (const node of nodes.slice(0, 6)) assert.equal(node.faces, naiveFaces((x, y, z) => mock.world.get(x, y, z) === 2, node), JSON.stringify(node));
    mock.change(0, 0, 30, 2);
    mock.change(0, 0, 31, 2);
    await until(page, "the change is there", async () => (await state(page)).occupied === occupied + 2);
    await same(page, mock);
    await close();
    mock.close();
  },

  async "wide: everything is clicked"() {
    const mock = await start({ side: 300, robots: 3 });
    const { page, close } = await open(mock);
    const s = await whole(page);
    assert.equal(s.theme, "light");
    await says(page, "#status", /Live/);
    await says(page, "#title", /mock: forest/);
    await says(page, "#legend", /Height.*\d m/);
    await says(page, "#f-out", /\d KB\/s/);
    await says(page, "#keys", /all robots send.*robot1 alone.*paper’s method.*RACER/);
    await says(page, "#link-table", /robot2.*22 %.*3/);
    await says(page, "#f-missing", /3 of robot2/);
    await says(page, "#labels", /robot1/);
    await says(page, "#f-submaps", /^2 of robot1; 2 of robot2; 2 of robot3$/);
    await shot(page, "wide-light-height");

    await page.getByRole("radio", { name: "Robot", exact: true }).check();
    await whole(page, (s) => s.color === "robot");
    await says(page, "#legend", /Seen last by.*robot1.*not known/);
    await shot(page, "wide-light-robot");
    await page.getByRole("radio", { name: "Age", exact: true }).check();
    await says(page, "#legend", /10 min.*now.*older than this page/);
    await shot(page, "wide-light-age");
    await page.getByRole("radio", { name: "Height", exact: true }).check();

    await page.getByLabel("Hide above", { exact: true }).check();
    await says(page, "#cut-at", /\d m/);
    await page.getByLabel("Height above which voxels are hidden").press("ArrowLeft");
    await shot(page, "wide-light-cut");
    await page.getByLabel("Slice at").check();
    await says(page, "#legend", /occupied.*free.*unknown/);
    await page.getByLabel("Height of the slice").press("ArrowRight");
    await page.waitForTimeout(1_500);
    await shot(page, "wide-light-slice");
    await page.getByLabel("Slice at").uncheck();
    await page.getByLabel("Hide above", { exact: true }).uncheck();
    await says(page, "#cut-at", /off/);

    await page.getByLabel("Scans").check();
    await whole(page);
    await page.getByRole("button", { name: "Follow robot2" }).click();
    assert.equal((await state(page)).follows, 2);
    await page.waitForTimeout(2_500);
    await shot(page, "wide-light-follow");
    for (const name of ["Trails", "Links", "Labels"]) await page.getByLabel(name, { exact: true }).uncheck();
    await until(page, "labels are gone", async () => (await page.locator("#labels span:visible").count()) === 0);
    for (const name of ["Trails", "Links", "Labels"]) await page.getByLabel(name, { exact: true }).check();
    await page.getByRole("button", { name: "Whole map" }).click();
    assert.equal((await state(page)).follows, null);
    await page.getByRole("button", { name: "From above" }).click();
    await page.waitForTimeout(1_500);
    await shot(page, "wide-light-top");
    await page.getByRole("button", { name: "Whole map" }).click();

    await page.getByRole("radio", { name: /robot3/ }).check();
    await whole(page, (s) => s.robot === 3);
    await says(page, "#map-name", /of robot3, voxels of 20 cm/);
    await page.keyboard.press("1");
    await whole(page, (s) => s.robot === 1);

    await page.getByRole("button", { name: "Pause" }).click();
    await says(page, "#notices", /Paused/);
    const frozen = await page.evaluate(() => window.flockmap.blocks());
    await page.waitForTimeout(1_500);
    assert.deepEqual(await page.evaluate(() => window.flockmap.blocks()), frozen);
    await page.getByRole("button", { name: "Go on" }).click();
    await until(page, "no notice", async () => (await page.locator("#notices").textContent()) === "");
    await until(page, "the map went on", async () => JSON.stringify(await page.evaluate(() => window.flockmap.blocks())) !== JSON.stringify(frozen));

    await page.keyboard.press("?");
    assert.ok(await page.getByRole("dialog").isVisible());
    await shot(page, "wide-light-help");
    await page.getByRole("button", { name: "Close" }).click();
    await page.getByRole("button", { name: "Light or dark" }).click();
    assert.equal((await state(page)).theme, "dark");
    await page.keyboard.press("c");
    assert.equal((await state(page)).color, "robot");
    await page.mouse.move(900, 400);
    await page.mouse.down();
    await page.mouse.move(1_000, 430, { steps: 4 });
    await page.mouse.up();
    await page.mouse.wheel(0, -400);
    await whole(page);
    await page.keyboard.press("c");
    await page.keyboard.press("c");
    await shot(page, "wide-dark-height");
    await close();
    mock.close();
  },

  async "a loop is closed: the way that was flown moves with its submap, after a pause too"() {
    const mock = await start({ side: 160, robots: 2 });
    const { page, close } = await open(mock);
    await whole(page, (s) => s.trails[0].points > 5);
    assert.equal((await state(page)).trails[0].moved, null);
    mock.closeLoop(mock.robots[0], 1.5);
    await says(page, "#f-submaps", /^2 of robot1, moved 1.50 m; 2 of robot2$/);
    await shot(page, "loop-closed");
    await page.getByRole("button", { name: "Pause" }).click();
    mock.closeLoop(mock.robots[0], 0.5);
    await page.waitForTimeout(700);
    await says(page, "#f-submaps", /moved 1.50 m/);
    await page.getByRole("button", { name: "Go on" }).click();
    await says(page, "#f-submaps", /moved 1.00 m/);
    await close();
    mock.close();
  },

  async "narrow, by touch: the sheet opens, and all is within reach"() {
    for (const theme of ["light", "dark"]) {
      const mock = await start({ side: 200, robots: 3 });
      const { page, close } = await open(mock, { width: 400, height: 800, theme, touch: true });
      assert.equal((await whole(page)).theme, theme);
      const other = theme === "light" ? "dark" : "light";
      await page.emulateMedia({ colorScheme: other });
      await until(page, "the theme of the system", async () => (await state(page)).theme === other);
      await page.emulateMedia({ colorScheme: theme });
      await whole(page, (s) => s.theme === theme);
      const { distance } = await state(page);
      await pinch(page, 200, 330, 40, 90);
      await until(page, "two fingers came closer", async () => (await state(page)).distance < 0.8 * distance);
      await page.getByRole("button", { name: "Whole map" }).tap();
      await until(page, "the whole map", async () => Math.abs((await state(page)).distance / distance - 1) < 0.2);
      await shot(page, `narrow-${theme}`);
      const sheet = page.locator("#sheet");
      await sheet.tap();
      assert.equal(await sheet.getAttribute("aria-expanded"), "true");
      await page.getByRole("radio", { name: "Age", exact: true }).tap();
      assert.equal((await state(page)).color, "age");
      await page.getByRole("radio", { name: /robot2/ }).tap();
      await whole(page, (s) => s.robot === 2);
      await shot(page, `narrow-${theme}-sheet`);
      const small = await page.evaluate(() =>
        [...document.querySelectorAll("button, .segments label, #robots label, .check")]
          .filter((e) => e.checkVisibility() && e.getBoundingClientRect().height > 0)
          .map((e) => [e.id || e.className || e.textContent, e.getBoundingClientRect()])
          .filter(([, box]) => box.height < 30 || box.left < 0 || box.right > innerWidth)
          .map(([name]) => name),
      );
      assert.deepEqual(small, []);
      await sheet.tap();
      await page.getByRole("button", { name: "Pause" }).tap();
      await says(page, "#status", /Paused/);
      await close();
      mock.close();
    }
  },

  async "a recording: play, scrub, speed, keys"() {
    const mock = await start({ side: 240, robots: 2, playback: true });
    const { page, close } = await open(mock, { theme: "dark" });
    await until(page, "playback", async () => (await state(page))?.playback);
    assert.equal((await state(page)).paused, true);
    await page.getByLabel("Time", { exact: true }).fill("60");
    const half = await whole(page, (s) => s.playback.at > s.playback.begin + 59 && s.occupied > 1_000);
    await page.getByRole("button", { name: "Play" }).click();
    await until(page, "it plays", async () => (await state(page)).playback.plays);
    await page.getByLabel("Speed").selectOption("2");
    await until(page, "it is faster", async () => (await state(page)).playback.speed === 2);
    await whole(page, (s) => s.occupied > half.occupied);
    await page.locator("#scene").focus();
    await page.keyboard.press(" ");
    await until(page, "it stands", async () => !(await state(page)).playback.plays);
    await shot(page, "playback-dark");
    const at = (await state(page)).playback.at;
    await page.keyboard.press("ArrowLeft");
    await until(page, "5 s back", async () => Math.abs((await state(page)).playback.at - (at - 5)) < 0.2);
    await page.getByLabel("Time", { exact: true }).fill("20");
    await whole(page, (s) => s.occupied < half.occupied && s.occupied > 0);
    await says(page, "#player-time", /0:20 \/ 2:00/);
    mock.cut();
    await until(page, "the cut is noticed", async () => !(await state(page)).connected);
    await whole(page, (s) => s.connected && Math.abs(s.playback.at - s.playback.begin - 20) < 0.2 && !s.playback.plays);
    await says(page, "#status", /Recording/);
    await close();
    mock.close();
  },

  async "what goes wrong is said, and it goes on after that"() {
    const mock = await start({ side: 160, robots: 2, still: true });
    const { page, close } = await open(mock);
    await whole(page);
    mock.cut();
    await says(page, "#status", /Not connected|Live|Connecting/);
    await whole(page, (s) => s.connected);
    await same(page, mock);
    mock.end("the node was told to end");
    await says(page, "#notices", /the node was told to end.*Trying again/);
    await shot(page, "lost");
    await whole(page, (s) => s.connected);
    mock.damage();
    await says(page, "#notices", /damaged/);
    await whole(page, (s) => s.connected);
    mock.control.stalled = true;
    await says(page, "#notices", /Nothing was heard for \d s/);
    await says(page, "#status", /Late/);
    mock.control.stalled = false;
    await says(page, "#status", /Live/);
    mock.robots[1].silentSince = Date.now();
    mock.change(3, 3, 40, 2);
    mock.restart();
    await whole(page, (s) => s.connected);
    await until(page, "the map of the new run", async () => (await state(page)).occupied === tally(mock.world).occupied);
    await same(page, mock);
    await close();
    mock.close();
  },

  async "a token goes with everything, and without it that is said"() {
    const mock = await start({ side: 100, robots: 2, token: "a b&c" });
    const good = await open(mock, { hash: "#token=a%20b%26c" });
    await whole(good.page);
    await good.close();
    const bad = await open(mock);
    await says(bad.page, "#notices", /wants a token/);
    await bad.close();
    mock.close();
  },

  async "large screens"() {
    const mock = await start({ side: 300, robots: 3 });
    for (const theme of ["light", "dark"]) {
      const { page, close } = await open(mock, { width: 3_840, height: 2_160, theme });
      await whole(page);
      await shot(page, `4k-${theme}`);
      await close();
    }
    mock.close();
  },

  async "five million occupied voxels"() {
    const world = forest(1_640, 1_400);
    const { occupied, blocks } = tally(world);
    assert.ok(occupied >= 5_000_000);
    const mock = await start({ world, robots: 2, still: true });
    const { page, close } = await open(mock);
    const begun = Date.now();
    await until(page, "the map is there", async () => (await state(page))?.occupied === occupied, 180);
    const came = Date.now() - begun;
    const s = await whole(page);
    assert.ok(s.drawCalls <= 500 && s.triangles <= 30e6);
    const worst = { drawCalls: 0, triangles: 0, meshBytes: 0 };
    let frames = [];
    for (const way of [[200, 0], [-150, 60], [0, -60], [120, 20]]) {
      await page.mouse.move(900, 450);
      await page.mouse.down();
      for (let i = 1; i <= 8; i++) {
        await page.mouse.move(900 + (way[0] * i) / 8, 450 + (way[1] * i) / 8);
        await page.waitForTimeout(120);
        const now = await state(page);
        for (const key of Object.keys(worst)) worst[key] = Math.max(worst[key], now[key]);
        frames.push(now.frameMs);
      }
      await page.mouse.up();
      await page.mouse.wheel(0, -600);
    }
    frames = frames.slice(8).sort((a, b) => a - b);
    assert.ok(worst.drawCalls <= 500 && worst.triangles <= 30e6 && worst.meshBytes <= 256 * 2 ** 20);
    const end = await state(page);
    const heap = await page.evaluate(() => performance.memory?.usedJSHeapSize ?? 0);
    const ms = frames[frames.length >> 1];
    const mb = (n) => `${(n / 1e6).toFixed(0)} MB`;
    console.log(
      `  ${(occupied / 1e6).toFixed(2)} M occupied voxels in ${blocks} blocks, there after ${(came / 1e3).toFixed(1)} s; first picture: ` +
        `${s.drawCalls} draws, ${s.triangles} triangles, levels ${JSON.stringify(s.levels)}\n` +
        `  while it moves: at most ${worst.drawCalls} draws, ${worst.triangles} triangles; ${ms.toFixed(0)} ms a frame (median), ${(1e3 / ms).toFixed(1)} fps ` +
        `without a graphics card\n  memory: heap of the page ${mb(heap)}, blocks ${mb(end.mapBytes)}, meshes ${mb(worst.meshBytes)} at most`,
    );
    await shot(page, "five-million");
    await close();
    mock.close();
  },
};

let failed = 0;
for (const [name, part] of Object.entries(parts)) {
  if (process.env.ONLY && !name.includes(process.env.ONLY)) continue;
  const begin = Date.now();
  try {
    await part();
    console.log(`ok: ${name} (${((Date.now() - begin) / 1e3).toFixed(0)} s)`);
  } catch (error) {
    failed++;
    console.log(`FAILED: ${name}\n${error.stack}`);
  }
}
await browser.close();
process.exit(failed > 0 ? 1 : 0);
