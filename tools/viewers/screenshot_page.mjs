// node screenshot_page.mjs FILE.html PICTURE.png [WIDTH] [light|dark]: a page opened from file:// in headless Chromium.
// Prints as JSON: console errors and warnings, requests that left the page, and what the page's own parts are doing.
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";
import { withBrowser } from "./browser.mjs";

const [file, picture, width = "1280", scheme = "light"] = process.argv.slice(2);
const viewport = { width: Number(width), height: 900 };
await withBrowser({ viewport, colorScheme: scheme, reducedMotion: "reduce" }, async (browser) => {
  const page = await browser.newPage();
  const problems = [], requests = [];
  // Software rendering is slow to read pixels back and says so; that is about this machine and not about the page.
  const slow = /GPU stall due to ReadPixels|GL Driver Message|rAF timed out/;
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && !slow.test(message.text()) && problems.push(message.text()));
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("request", (request) => /^(data|blob):/.test(request.url()) || requests.push(request.url()));
  await page.goto(pathToFileURL(resolve(file)).href, { timeout: 150000 });
  const has_model = await page.evaluate(() => document.querySelector("model-viewer") !== null);
  if (has_model) {
    await page.evaluate(() => document.querySelector("model-viewer").scrollIntoView());
    await page.waitForFunction(() => document.querySelector("model-viewer")?.loaded, null, { timeout: 240000 });
  }
  const found = await page.evaluate(() => {
    const shown = [...document.querySelectorAll('.stage')].filter((stage) => stage.offsetHeight > 0).length;
    const angle = document.querySelector(".angle"), layer = [...document.querySelectorAll(".layer")].find((one) => one.dataset.count > 1);
    const before = layer?.style.backgroundPosition;
    if (angle) {
      angle.value = 700;
      angle.dispatchEvent(new Event("input"));
    }
    const turned = layer ? layer.style.backgroundPosition !== before : null;
    if (angle) {
      angle.value = 125;
      angle.dispatchEvent(new Event("input"));
    }
    const wipe = document.querySelector(".wipe");
    if (wipe) {
      wipe.value = 500;
      wipe.dispatchEvent(new Event("input"));
    }
    const numbers = [...document.querySelectorAll("thead th")].map((head) => (head.click(), document.querySelectorAll("tbody tr")[0]?.id));
    scrollTo(0, 0);
    return {
      shown,
      turned,
      cut: document.querySelector(".stage")?.style.getPropertyValue("--cut"),
      materials: document.querySelector("model-viewer")?.model?.materials.map((material) => material.name) ?? [],
      sorted: numbers,
      overflow: document.documentElement.scrollWidth - innerWidth,
    };
  });
  if (has_model) await page.waitForTimeout(2500);
  await page.screenshot({ path: picture, fullPage: true, timeout: 240000 });
  console.log(JSON.stringify({ problems, requests: requests.slice(1), ...found }));
});
