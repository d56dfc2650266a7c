// Chromium without a graphics card, for tests and pictures.

import { readFileSync } from "node:fs";
import { chromium } from "playwright-core";

export const launch = () =>
  chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    headless: true,
    args: [
      "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run",
      "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--enable-precise-memory-info",
      // What a test puts in the place of a page counts as public, and would not reach the loopback.
      "--disable-features=LocalNetworkAccessChecks,LocalNetworkAccessChecksWebSockets",
    ],
  });

export const state = (page) => page.evaluate(() => window.flockmap?.state());

/** Waits until something is so; the machine may be slow. */
export async function until(page, what, look, seconds = 60) {
  const end = Date.now() + 1e3 * seconds;
  for (;;) {
    const last = await look();
    if (last) return last;
    if (Date.now() > end) throw new Error(`not after ${seconds} s: ${what}; ${JSON.stringify(await state(page))}`);
    await page.waitForTimeout(150);
  }
}

/** The page of this folder in the place of the one that the program has. */
export async function ownPage(page) {
  const types = { html: "text/html", js: "text/javascript", css: "text/css" };
  await page.route(/\/(view\.js|worker\.js|view\.css|)$/, (route) => {
    const name = new URL(route.request().url()).pathname.slice(1) || "index.html";
    const body = readFileSync(new URL(`../../assets/${name}`, import.meta.url));
    return route.fulfill({ body, contentType: types[name.split(".").pop()] });
  });
}

/** Faces of a node of 64³ voxels, voxel by voxel: `occupied` says whether one is. */
export function naiveFaces(occupied, node) {
  let faces = 0;
  for (let z = 64 * node.z; z < 64 * node.z + 64; z++) for (let y = 64 * node.y; y < 64 * node.y + 64; y++) for (let x = 64 * node.x; x < 64 * node.x + 64; x++) {
    if (!occupied(x, y, z)) continue;
    for (const [a, b, c] of [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]) if (!occupied(x + a, y + b, z + c)) faces++;
  }
  return faces;
}
