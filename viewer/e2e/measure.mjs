// How fast the page is: node measure.mjs URL SCREENSHOT LABEL..., prints the browser's own figures as JSON.
import { open, screenOf } from "./browser.mjs";

const [url, screenshot, ...labels] = process.argv.slice(2);
const { browser, page, noted } = await open(url);
// The processor time of the page's main thread: what a loaded machine does not change.
const tools = await page.context().newCDPSession(page);
await tools.send("Performance.enable", { timeDomain: "threadTicks" });
const cpu = async () => {
  const { metrics } = await tools.send("Performance.getMetrics");
  return 1000 * metrics.find((metric) => metric.name === "ThreadTime").value;
};
// And that of the browser's drawing, which is most of a frame where there is no graphics card.
const all = await browser.newBrowserCDPSession();
const drawingCpu = async () => {
  const { processInfo } = await all.send("SystemInfo.getProcessInfo");
  return 1000 * processInfo.find((each) => each.type === "GPU").cpuTime;
};
await page.evaluate(() => {
  window.longTasks = [];
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) window.longTasks.push([entry.startTime, entry.duration]);
  }).observe({ type: "longtask", buffered: true });
});
await page.waitForTimeout(3000);
const measures = (name) =>
  page.evaluate((wanted) => performance.getEntriesByName(wanted).map((entry) => entry.duration), `valuemap:${name}`);
const now = () => page.evaluate(() => performance.now());
const tasksSince = (start) =>
  page.evaluate((from) => window.longTasks.filter(([at]) => at >= from).map(([, duration]) => duration), start);

const seen = { interactive_ms: (await measures("interactive"))[0], drawn: Number(await page.evaluate(() => document.body.dataset.drawnLabels)) };
seen.loading_cpu_ms = await cpu();


async function frames(action) {
  await page.evaluate(() => {
    window.counted = [];
    const step = (time) => {
      window.counted.push(time);
      window.counting = requestAnimationFrame(step);
    };
    window.counting = requestAnimationFrame(step);
  });
  const start = await now();
  const before = await cpu();
  const drawnBefore = await drawingCpu();
  await action();
  const used = (await cpu()) - before;
  const drawn = (await drawingCpu()) - drawnBefore;
  const between = await page.evaluate(() => {
    cancelAnimationFrame(window.counting);
    return window.counted.slice(1).map((time, i) => time - window.counted[i]);
  });
  const tasks = await tasksSince(start);
  return {
    longest_task_ms: Math.max(0, ...tasks),
    long_tasks: tasks.length,
    frames: between.length,
    median_frame_ms: median(between),
    longest_frame_ms: Math.max(...between),
    cpu_per_frame_ms: used / Math.max(1, between.length),
    drawing_cpu_per_frame_ms: drawn / Math.max(1, between.length),
  };
}
const median = (values) => [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? null;

/** As a hand or a touchpad does: the next event comes whether the page has answered the last one or not. */
async function events(count, ms, send) {
  const sent = [];
  for (let i = 1; i <= count; i++) {
    sent.push(send(i));
    await new Promise((resolve) => setTimeout(resolve, ms));
  }
  await Promise.all(sent);
}

const [x, y] = [840, 480];
await page.mouse.move(x, y);
await page.mouse.down();
// Once around in two seconds, 300 px away: more than a picture of the ground reaches beyond the view.
seen.pan = await frames(() =>
  events(250, 8, (i) => page.mouse.move(x - 300 + 300 * Math.cos((2 * Math.PI * i) / 250), y + 300 * Math.sin((2 * Math.PI * i) / 250))),
);
await page.mouse.up();
seen.zoom = await frames(async () => {
  await events(80, 16, () => page.mouse.wheel(0, -12));
  await events(80, 16, () => page.mouse.wheel(0, 12));
});
await page.screenshot({ path: screenshot });

await page.evaluate(() => {
  performance.setResourceTimingBufferSize(10000);
  window.painted = [];
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) if (entry.name === "pointerup") window.painted.push(entry.duration);
  }).observe({ type: "event", durationThreshold: 16 });
});

/** Click labels: the time until what they rest on is painted, and what the main thread worked for it. */
async function clicks(click) {
  const figures = { ms: [], cpu_ms: [], painted_ms: [] };
  for (const label of labels.map(Number)) {
    await page.keyboard.press("Escape");
    await page.evaluate((id) => {
      const view = window.valuemap.getView();
      const box = document.getElementById("deck").getBoundingClientRect();
      const at = window.valuemap.screenOf(id);
      const scale = 2 ** -view.zoom;
      const [dx, dy] = [at[0] - box.left - box.width / 2, at[1] - box.top - box.height / 2];
      window.valuemap.setView({ east: view.east + dx * scale + 120 / 16, north: view.north - dy * scale, zoom: 4 });
      window.painted = [];
    }, label);
    await page.waitForTimeout(700);
    const before = (await measures("click")).length;
    const used = await cpu();
    await click(...(await screenOf(page, label)));
    await page.waitForFunction((count) => performance.getEntriesByName("valuemap:click").length > count, before);
    figures.cpu_ms.push((await cpu()) - used);
    figures.ms.push((await measures("click"))[before]);
    await page.waitForTimeout(500); // The browser tells of events some time after they were painted.
    figures.painted_ms.push(await page.evaluate(() => Math.max(0, ...window.painted)));
  }
  return figures;
}
// A hand comes to rest on a label before it clicks, and holds the button down for a moment.
seen.by_hand = await clicks(async (x, y) => {
  await page.mouse.move(x, y);
  await page.waitForTimeout(100);
  await page.mouse.click(x, y, { delay: 80 });
});
// No time between: nothing could be asked for before.
seen.at_once = await clicks((x, y) => page.mouse.click(x, y));
seen.answers_ms = await page.evaluate(() =>
  performance
    .getEntriesByType("resource")
    .filter((entry) => entry.name.includes("/api/label?"))
    .map((entry) => entry.duration),
);
seen.titles = await page.locator("#title").innerText();
seen.complaints = noted.complaints;
await browser.close();
console.log(JSON.stringify(seen));
