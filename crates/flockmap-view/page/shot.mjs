// A picture of the page at the end of a replay. usage: node shot.mjs URL PICTURE.jpg
import { chromium } from "playwright-core";

const [url, out] = process.argv.slice(2);
const args = [
  "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic",
];
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM, args });
const page = await browser.newPage({ viewport: { width: 1600, height: 900 }, colorScheme: "light" });
await page.goto(url);
const is = (words) => page.waitForFunction(words, null, { timeout: 120_000 });
await is("window.flockmap?.state().complete && window.flockmap.state().playback");
await page.getByText("Robot", { exact: true }).first().click();
// The end of the recording, at rest and drawn in full.
await page.evaluate(() => {
  const scrub = document.getElementById("scrub");
  scrub.value = scrub.max;
  scrub.dispatchEvent(new Event("input"));
});
await is("(({ at, end }) => at === end)(window.flockmap.state().playback)");
await is("window.flockmap.state().complete && window.flockmap.state().pendingMeshes === 0");
await page.waitForTimeout(6_000);
console.log(JSON.stringify(await page.evaluate("window.flockmap.state()")));
await page.screenshot({ path: out, type: "jpeg", quality: 82 });
await browser.close();
