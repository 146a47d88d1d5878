// Debian's Chromium without a window, and a page that notes everything it asks for and complains of.
import { chromium } from "playwright-core";

export async function open(url, { width = 1440, height = 900, theme = "light" } = {}) {
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: theme });
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
