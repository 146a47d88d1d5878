// What the GPU is handed and draws while somebody zooms and moves the map: node levels.mjs URL ZOOM..., prints bytes and corners as JSON.
import { frameFrom, lookFrom, open } from "./browser.mjs";

const [url, ...zooms] = process.argv.slice(2);
const { browser, page, noted } = await open(url, { width: 800, height: 600 });
await page.waitForFunction(() => document.body.dataset.settled === "true");

/** Every zoom after the other: the bytes of each, and the most in one frame. */
async function through(all) {
  const steps = [];
  for (const zoom of all) {
    await page.evaluate(() => Object.assign(window.handed, { most: 0, all: 0 }));
    await lookFrom(page, zoom);
    steps.push({ ...(await handed()), frame: await frameFrom(page, zoom) });
  }
  return steps;
}

const handed = () => page.evaluate(() => ({ most: window.handed.most, all: window.handed.all }));
const seen = { noted, opened: await handed() };
const there = zooms.map(Number);
seen.first = await through(there);
seen.again = await through(there);
// A pass that is hidden: levels are made anew, nothing at once.
await page.evaluate(() => Object.assign(window.handed, { most: 0, all: 0 }));
await page.evaluate(
  () =>
    new Promise((resolve) => {
      // The page hears of it first.
      addEventListener("hashchange", () => resolve((document.body.dataset.settled = "false")), { once: true });
      location.hash = `${location.hash}&nopass=0`;
    }),
);
await page.waitForFunction(() => document.body.dataset.settled === "true");
seen.hidden = { ...(await handed()), frame: await frameFrom(page, there[0]) };
await browser.close();
console.log(JSON.stringify(seen));
