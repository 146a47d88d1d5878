// What somebody does with a map: node review.mjs URL STEP LABEL SCREENSHOT, prints what was seen as JSON.
import { frameFrom, open, screenOf } from "./browser.mjs";

const [url, step, label, screenshot] = process.argv.slice(2);
const id = Number(label);
const { browser, page, noted } = await open(url);
const seen = { noted };

const text = (selector) => page.locator(selector).first().innerText();
const stateInList = () => page.locator(`#list [data-label="${id}"] .dot`).getAttribute("aria-label");
const crops = () =>
  page.$$eval("#details .crop img", (images) => images.filter((image) => image.complete && image.naturalWidth > 0).length);

await page.waitForFunction(() => Number(document.body.dataset.drawnLabels) > 0);
seen.drawn = Number(await page.evaluate(() => document.body.dataset.drawnLabels));
seen.title = await page.title();
seen.texts = await page.locator("#filters .check .text").allInnerTexts();

if (step === "reject") {
  seen.at = await screenOf(page, id);
  await page.waitForTimeout(1000);
  await page.screenshot({ path: screenshot });
  // The page asks for what it will show once the pointer rests on a label, and not again when it is clicked.
  const askedFor = () => noted.requests.filter((asked) => asked.includes(`/api/label?id=${id}`)).length;
  await page.mouse.move(...seen.at);
  while (!askedFor()) await page.waitForTimeout(20);
  seen.hidden = await page.locator("#details").isHidden();
  await page.mouse.click(...seen.at);
  await page.waitForFunction((title) => document.querySelector("#title")?.textContent === title, `Label ${id}`);
  seen.asked = askedFor();
  await page.waitForFunction(() => [...document.querySelectorAll("#details .large img")].some((image) => image.naturalWidth > 0));
  await page.waitForSelector("#details .gallery[data-complete]");
  seen.thumbs = await page.locator("#details .thumb").count();
  seen.crops = await crops();
  seen.sub = await text("#details .sub");
  seen.first = await text("#details .caption");
  await page.keyboard.press("ArrowRight");
  seen.second = await text("#details .caption");
  await page.keyboard.press("Enter");
  await page.waitForFunction(() => document.querySelector("#whole img")?.naturalWidth === 640);
  await page.keyboard.press("Escape");
  await page.waitForSelector("#whole", { state: "detached" });
  await page.keyboard.press("r");
  await page.waitForSelector("#details .state.rejected");
  await page.waitForFunction((wanted) => document.querySelector(`#list [data-label="${wanted}"] .dot`)?.getAttribute("aria-label") === "rejected", id);
  seen.pressed = await page.locator("#reject").getAttribute("aria-pressed");

  const saved = page.waitForResponse((response) => response.request().method() === "POST");
  await page.fill("#note", '"><img src=x onerror="document.title=1">');
  await page.locator("#note").blur();
  await saved;
  await page.keyboard.press("Escape");
  await page.waitForSelector("#details", { state: "hidden" });

  // An empty place: somewhere on the map with no label near it.
  await page.mouse.click(seen.at[0] + 40, seen.at[1] + 40);
  await page.waitForSelector("#answer");
  seen.answer = await text("#answer");
  seen.heading = await text("#title");

  // The keyboard alone: the next label in the list, accepted. The first of the list may be the rejected one.
  await page.keyboard.press("Escape");
  await page.keyboard.press("n");
  await page.waitForFunction(() => document.querySelector("#title")?.textContent.startsWith("Label "));
  if ((await text("#title")) === `Label ${id}`) {
    await page.keyboard.press("n");
    await page.waitForFunction((title) => document.querySelector("#title")?.textContent !== title, `Label ${id}`);
  }
  seen.next = await text("#title");
  await page.keyboard.press("a");
  await page.waitForSelector("#details .state.accepted");

  // It is moved by less than the mark of a label is wide, and stays accepted.
  seen.nextId = Number(seen.next.slice("Label ".length));
  await page.waitForTimeout(400);
  const from = await screenOf(page, seen.nextId);
  await page.keyboard.press("m");
  await page.waitForSelector("body.moving");
  await page.mouse.click(from[0] + 6, from[1] - 3);
  await page.waitForFunction(() => document.querySelector("#move")?.textContent.startsWith("Moved"));
  await page.waitForSelector("#details .state.accepted");
  seen.movedM = await page.evaluate(() => [6, 3].map((px) => px / 2 ** window.valuemap.getView().zoom));
  await page.waitForTimeout(400);
  seen.address = page.url();

  // The address holds the view: loaded again, it shows the same.
  await page.reload();
  await page.waitForFunction((title) => document.querySelector("#title")?.textContent === title, seen.next);
  seen.sameView = await page.evaluate(() => location.hash);
} else {
  seen.state = await stateInList();
  await page.fill("#search", String(id));
  await page.keyboard.press("Enter");
  await page.waitForFunction((title) => document.querySelector("#title")?.textContent === title, `Label ${id}`);
  seen.review = await text("#details .state");
  seen.alert = await page.locator("#details .alert").allInnerTexts();
  seen.note = await page.inputValue("#note");
  await page.uncheck("#filters label.check:has(.text:text-is('Rejected')) input");
  await page.uncheck("#filters label.check:has(.text:text-is('Check again')) input");
  await page.waitForSelector(`#list [data-label="${id}"]`, { state: "detached" });
  seen.hidden = true;
  // Each filter at its end shows nothing, with the keyboard alone; at its beginning everything again.
  const listed = () => page.locator("#list [data-label]").count();
  seen.filtered = {};
  for (const [name, end, start] of [["votes ≥", "End", "Home"], ["existence ≤", "Home", "End"], ["passes ≥", "End", "Home"]]) {
    const slider = page.locator(`#filters input[type=range][aria-label="${name}"]`);
    await slider.focus();
    await page.keyboard.press(end);
    const most = await slider.inputValue();
    seen.filtered[name.split(" ")[0]] = await listed();
    seen[`${name} at`] = most;
    await page.keyboard.press(start);
  }
  const classes = page.locator("#filters fieldset:has(legend:text-is('Class')) input");
  for (const box of await classes.all()) await box.uncheck();
  seen.filtered.class = await listed();
  for (const box of await classes.all()) await box.check();
  seen.filtered.all = await listed();
}
// A city from far away: streets driven twice are drawn once.
seen.far = await frameFrom(page, -5);
seen.legend = await page.locator("#legend span").allInnerTexts();
// On a phone everything is within reach: the filters and the list behind a button, and nothing beyond the screen.
if (step !== "reject") {
  await page.keyboard.press("Escape");
  await page.setViewportSize({ width: 390, height: 844 });
  seen.phone = { beyond: await page.locator("#bar").evaluate((bar) => bar.scrollWidth - bar.clientWidth) };
  seen.phone.list = [await page.locator("#list").isVisible()];
  await page.click("#menu");
  seen.phone.list.push(await page.locator("#list").isVisible());
  await page.locator("#list [data-label]").first().click();
  await page.waitForSelector("#details h2");
  seen.phone.list.push(await page.locator("#list").isVisible());
}
// What a screen reader would say: everything that can be used has a name.
seen.unnamed = await page.evaluate(() =>
  [...document.querySelectorAll("button, input, textarea, select, a[href], [role], canvas")]
    .filter((each) => each.getAttribute("aria-hidden") !== "true" && !["presentation", "none"].includes(each.getAttribute("role")))
    .filter((each) => !each.closest("#deck") || each.id === "deck")
    .filter((each) => {
      const named = each.getAttribute("aria-label") || each.getAttribute("title") || each.textContent.trim();
      return !(named || each.labels?.length || each.id === "status");
    })
    .map((each) => each.outerHTML.slice(0, 120)),
);
seen.pwned = await page.evaluate(() => document.title);
seen.scripts = await page.evaluate(() => document.querySelectorAll("script:not([src]), img[onerror]").length);
await browser.close();
console.log(JSON.stringify(seen));
