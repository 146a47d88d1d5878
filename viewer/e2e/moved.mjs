// The map as it looks before it is moved, after, and painted anew there: node moved.mjs URL PX BEFORE MOVED PAINTED.
import { open } from "./browser.mjs";

const [url, px, before, moved, painted] = process.argv.slice(2);
const { browser, page, noted } = await open(url, { width: 800, height: 600 });
const settled = () => page.waitForFunction(() => document.body.dataset.settled === "true");
const shoot = async (path) => {
  await settled();
  await page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve))));
  await page.locator("#deck").screenshot({ path });
};
await shoot(before);
await page.evaluate((step) => {
  Object.assign(window.drawn, { all: 0 });
  const view = window.valuemap.getView();
  window.valuemap.setView({ ...view, east: view.east + step / 2 ** view.zoom });
}, Number(px));
await shoot(moved);
const seen = { noted, painted: await page.evaluate(() => window.drawn.all) };
// Dark and light again: it is painted anew at this place.
await page.keyboard.press("d");
await settled();
await page.keyboard.press("d");
await shoot(painted);
seen.paintedAnew = await page.evaluate(() => window.drawn.all);
await browser.close();
console.log(JSON.stringify(seen));
