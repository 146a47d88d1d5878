// Debian's Chromium without a window, and a page that notes everything it asks for and complains of.
import { chromium } from "playwright-core";

export async function open(url, { width = 1440, height = 900, theme = "light" } = {}) {
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme });
  // What each frame hands the GPU: shapes drawn one by one, and corners of triangles in lists.
  await context.addInitScript(() => {
    const count = (name, of) => {
      const draw = WebGL2RenderingContext.prototype[name];
      WebGL2RenderingContext.prototype[name] = function (...given) {
        const [instances, corners] = of(given);
        window.given = { instances: (window.given?.instances ?? 0) + instances, corners: (window.given?.corners ?? 0) + corners };
        return draw.apply(this, given);
      };
    };
    count("drawArraysInstanced", (given) => [given[3], 0]);
    count("drawElementsInstanced", (given) => [given[4], 0]);
    count("drawArrays", (given) => [0, given[2]]);
    count("drawElements", (given) => [0, given[1]]);
    // The bytes that the GPU was handed: in this frame, in the frame with the most, and in all.
    window.handed = { now: 0, most: 0, all: 0 };
    for (const [name, at] of [["bufferData", 1], ["bufferSubData", 2]]) {
      const hand = WebGL2RenderingContext.prototype[name];
      WebGL2RenderingContext.prototype[name] = function (...given) {
        const bytes = given[at]?.byteLength ?? 0;
        window.handed.now += bytes;
        window.handed.all += bytes;
        window.handed.most = Math.max(window.handed.most, window.handed.now);
        return hand.apply(this, given);
      };
    }
    const frame = () => {
      window.handed.now = 0;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  });
  const page = await context.newPage();
  page.setDefaultTimeout(Number(process.env.PAGE_TIMEOUT_MS ?? 120000));
  const noted = { requests: [], complaints: [] };
  page.on("request", (request) => noted.requests.push(request.url()));
  page.on("websocket", (socket) => noted.requests.push(socket.url()));
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type())) noted.complaints.push(message.text());
  });
  page.on("pageerror", (error) => noted.complaints.push(error.message));
  await page.goto(url);
  await page.waitForSelector("body[data-ready]", { state: "attached" });
  return { browser, page, noted };
}

/** Where a label is on the screen. */
export const screenOf = (page, id) => page.evaluate((label) => window.valuemap.screenOf(label), id);

/** Look from this zoom, and wait until everything in view is drawn. */
export async function lookFrom(page, zoom) {
  await page.evaluate((wanted) => {
    document.body.dataset.settled = "false"; // Until a frame of the new view says that it is.
    window.valuemap.setView({ ...window.valuemap.getView(), zoom: wanted });
  }, zoom);
  await page.waitForFunction(() => document.body.dataset.settled === "true");
}

/** What one frame draws, seen from this zoom. */
export async function frameFrom(page, zoom) {
  await lookFrom(page, zoom);
  return page.evaluate(async () => {
    const painted = () => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
    window.given = undefined;
    const view = window.valuemap.getView();
    window.valuemap.setView({ ...view, east: view.east + 1 });
    while (!window.given) await painted();
    window.valuemap.setView(view);
    return window.given;
  });
}
