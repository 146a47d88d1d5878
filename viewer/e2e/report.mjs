// The report from disk: node report.mjs FILE SCRIPTS LABEL SCREENSHOT..., prints what was seen as JSON.
// SCRIPTS is "on" or "off"; LABEL is the id of a label, or "" for the first that is listed.
import { chromium } from "playwright-core";
import { pathToFileURL } from "node:url";

const [file, scripts, label, ...screenshots] = process.argv.slice(2);
const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--disable-gpu"],
});
const context = await browser.newContext({
  viewport: { width: 1280, height: 900 },
  colorScheme: process.env.THEME ?? "light",
  javaScriptEnabled: scripts === "on",
});
await context.setOffline(true);
const page = await context.newPage();
page.setDefaultTimeout(Number(process.env.PAGE_TIMEOUT_MS ?? 120000));
const seen = { requests: [], complaints: [] };
page.on("request", (request) => {
  if (!request.url().startsWith("data:")) seen.requests.push(request.url());
});
page.on("console", (message) => {
  if (["error", "warning"].includes(message.type())) seen.complaints.push(message.text());
});
page.on("pageerror", (error) => seen.complaints.push(error.message));
page.on("dialog", (dialog) => {
  seen.complaints.push(`a script of somebody else ran: ${dialog.message()}`);
  void dialog.dismiss();
});
await page.goto(pathToFileURL(file).href);

const visible = (selector) => page.locator(selector).filter({ visible: true }).count();
if (scripts === "on") {
  await page.waitForSelector("html[data-ready]");
  seen.marks = await page.locator("#legend b").allInnerTexts();
  const timing = () => {
    const [navigation] = performance.getEntriesByType("navigation");
    const [ready] = performance.getEntriesByName("valuemap:ready");
    const paint = performance.getEntriesByName("first-contentful-paint")[0];
    return { ready: ready.startTime, loaded: navigation.loadEventEnd, paint: paint?.startTime ?? null };
  };
  await page.waitForFunction(() => performance.getEntriesByType("navigation")[0].loadEventEnd > 0);
  seen.opened_ms = await page.evaluate(timing);
  seen.labels = Number(await page.getAttribute("html", "data-ready"));
  // Colours of the map: a ground without labels has one or two.
  seen.colors = await page.evaluate(() => {
    const canvas = document.getElementById("map");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const found = new Set();
    for (let i = 0; i < data.length; i += 4) found.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
    return found.size;
  });
  if (screenshots[0]) await page.screenshot({ path: screenshots[0] });
  if (label) {
    await page.fill("#search", label);
    await page.keyboard.press("Enter");
  } else {
    await page.locator("button[data-show]").first().click();
  }
  await page.waitForSelector("#panel h3");
  seen.chosen = await page.locator("#panel h3").innerText();
  seen.panel = await page.locator("#panel").innerText();
  seen.rows = await page.locator("#panel tbody tr").count();
  seen.crops = await page.locator("#panel .crops img").count();
  // Clicked where it is drawn: a label that is shown is in the middle of the map.
  await page.locator("#map").scrollIntoViewIfNeeded();
  const box = await page.locator("#map").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  await page.mouse.click(box.x + 4, box.y + 4);
  seen.cleared = (await page.locator("#panel h3").count()) === 0;
  seen.clicked_ms = await page.evaluate(() => performance.now());
  await page.mouse.click(x, y);
  await page.waitForSelector("#panel h3");
  seen.again = await page.locator("#panel h3").innerText();
  await page.locator("#map").focus();
  await page.keyboard.press("n");
  seen.next = await page.locator("#panel h3").innerText();
  if (screenshots[1]) await page.screenshot({ path: screenshots[1] });
} else if (screenshots[0]) {
  await page.screenshot({ path: screenshots[0] });
}
seen.tables = await visible("table");
seen.figures = await visible("#figures svg");
seen.map = await page.locator("#static-map img").filter({ visible: true }).count();
seen.cards = await visible(".card");
seen.controls = await visible("#explore, button");
seen.text = await page.locator("body").innerText();
if (screenshots[2]) await page.screenshot({ path: screenshots[2], fullPage: true });
// On a phone nothing is wider than the screen, and no row is higher than its words need.
await page.setViewportSize({ width: 390, height: 844 });
seen.phone = await page.evaluate(() => ({
  beyond: document.documentElement.scrollWidth - innerWidth,
  lines: Math.max(...[...document.querySelectorAll("#tables td:first-child")].map((cell) => {
    const line = parseFloat(getComputedStyle(cell).fontSize) * 1.5;
    return cell.getBoundingClientRect().height / line / Math.ceil(cell.innerText.length / 8 + 1);
  })),
}));
// In print a picture that is higher than the paper keeps its proportions.
await page.setViewportSize({ width: 1280, height: 900 });
await page.emulateMedia({ media: "print" });
seen.print = await page.evaluate(async () => {
  const picture = document.querySelector("#static-map img");
  picture.src = 'data:image/svg+xml,<svg xmlns="http://www.w3.org/2000/svg" width="1000" height="2000"/>';
  await picture.decode();
  const { width, height } = picture.getBoundingClientRect();
  return { proportion: width / height, height };
});
await browser.close();
console.log(JSON.stringify(seen));
