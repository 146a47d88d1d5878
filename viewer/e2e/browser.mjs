// Debian's Chromium without a window, and a page that notes everything it asks for and complains of.
import { chromium } from "playwright-core";

export async function open(url, { width = 1440, height = 900, theme = "light" } = {}) {
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme });
  // What is drawn: shapes one by one (instances); corners of triangles in lists, on the screen in this frame, and on
  // pictures in this frame, in the frame with the most, and in all; rectangles with a picture in this frame.
  await context.addInitScript(() => {
    window.drawn = { instances: 0, screen: 0, pictures: 0, painted: 0, most: 0, all: 0 };
    const wrap = (name, before) => {
      const call = WebGL2RenderingContext.prototype[name];
      WebGL2RenderingContext.prototype[name] = function (...given) {
        before(...given);
        return call.apply(this, given);
      };
    };
    let target = null;
    wrap("bindFramebuffer", (which, framebuffer) => {
      if (which !== WebGL2RenderingContext.READ_FRAMEBUFFER) target = framebuffer;
    });
    wrap("drawArraysInstanced", (mode, first, count, instances) => (window.drawn.instances += instances));
    wrap("drawElementsInstanced", (mode, count, type, offset, instances) => (window.drawn.instances += instances));
    wrap("drawArrays", () => window.drawn.pictures++);
    wrap("drawElements", (mode, count) => {
      const { drawn } = window;
      if (!target) drawn.screen += count;
      else {
        drawn.painted += count;
        drawn.all += count;
        drawn.most = Math.max(drawn.most, drawn.painted);
      }
    });
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
      Object.assign(window.drawn, { screen: 0, pictures: 0, painted: 0 });
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

/** Look from this zoom, at another place if one is given, and wait until everything in view is drawn. */
export async function lookFrom(page, zoom, place = {}) {
  await page.evaluate((wanted) => {
    document.body.dataset.settled = "false"; // Until a frame of the new view says that it is.
    window.valuemap.setView({ ...window.valuemap.getView(), ...wanted });
  }, { ...place, zoom });
  await page.waitForFunction(() => document.body.dataset.settled === "true");
}

/** What moving the map draws at this zoom: a frame of a small step, and all frames until the ground is painted anew. The map ends where it was. */
export async function frameFrom(page, zoom) {
  await lookFrom(page, zoom);
  const start = await page.evaluate(() => window.valuemap.getView());
  const stepped = (px) =>
    page.evaluate(async (step) => {
      Object.assign(window.drawn, { instances: 0, most: 0, all: 0 });
      document.body.dataset.settled = "false";
      const view = window.valuemap.getView();
      window.valuemap.setView({ ...view, east: view.east + step / 2 ** view.zoom });
      let frame = { pictures: 0 };
      while (!frame.pictures || document.body.dataset.settled !== "true") {
        // After the page's own callback, in which it draws.
        await new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
        if (window.drawn.pictures) frame = { ...window.drawn };
      }
      return frame;
    }, px);
  const moved = await stepped(20);
  const { most, all, instances } = await stepped(200);
  await lookFrom(page, zoom, start);
  return { moved, most, all, instances };
}
