// How a label that is gone is shown: node gone.mjs URL LABEL SHOT.
import { open } from "./browser.mjs";

const [url, label, shot] = process.argv.slice(2);
const { browser, page, noted } = await open(url);
const ready = () => page.waitForFunction(() => document.body.dataset.ready === "true");
await ready();
const texts = (selector) => page.locator(selector).allTextContents();
const seen = { noted, name: (await texts("#bar .name"))[0], list: await texts("#list button"), title: (await texts("#filters h2"))[0] };
seen.legend = await texts("#legend span");
await page.evaluate((id) => (location.hash = `label=${id}`), label);
await page.waitForSelector("#details .gone");
seen.sub = (await texts("#details .sub"))[0];
seen.said = await texts("#details p.gone");
await page.screenshot({ path: shot });
await page.locator("#updates label", { hasText: "gone" }).locator("input").uncheck();
seen.filtered = await texts("#list button");
seen.address = await page.evaluate(() => new Promise((resolve) => setTimeout(() => resolve(location.hash), 400)));
await browser.close();
console.log(JSON.stringify(seen));
