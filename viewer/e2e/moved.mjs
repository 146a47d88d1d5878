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
// Somebody who zooms by little sees the same picture stretched, until the zoom rests; the test says when.
seen.zoomed = await page.evaluate(async () => {
  const later = window.setTimeout;
  const rests = [];
  window.setTimeout = (call) => rests.push(call);
  const view = window.valuemap.getView();
  const frame = async (zoom) => {
    Object.assign(window.drawn, { all: 0, pictures: 0 });
    window.valuemap.setView({ ...view, zoom });
    while (!window.drawn.pictures) await new Promise((resolve) => requestAnimationFrame(() => later(resolve)));
    return window.drawn.all;
  };
  const painted = [await frame(view.zoom + 0.1), await frame(view.zoom + 0.2)];
  window.setTimeout = later;
  document.body.dataset.settled = "false";
  for (const rest of rests) rest();
  while (document.body.dataset.settled !== "true") await new Promise(requestAnimationFrame);
  painted.push(window.drawn.all);
  window.valuemap.setView(view);
  return painted;
});
await settled();
await page.evaluate(() => Object.assign(window.drawn, { all: 0 }));
// Dark and light again: it is painted anew at this place.
await page.keyboard.press("d");
await settled();
await page.keyboard.press("d");
await shoot(painted);
seen.paintedAnew = await page.evaluate(() => window.drawn.all);
await browser.close();
console.log(JSON.stringify(seen));
