// node studio_tour.mjs URL FOLDER JSON: a tour through the page of `fd_mitsuba studio`, as one PNG after the other in
// FOLDER. JSON: mesh to open, prompt, drag of the gizmo [[x, y], [x, y]]. Prints as JSON for each picture: its file, for
// how many milliseconds to show it, and the words for what is done in it.
import { join } from "node:path";
import { drag, field, open, screenshot, text, upload, withStudioBrowser } from "./studio_driver.mjs";

const [url, folder, given] = process.argv.slice(2);
const options = JSON.parse(given);
const taken = [];
let words = "";

async function take(page, milliseconds) {
  const file = `${String(taken.length).padStart(3, "0")}.png`;
  await screenshot(page, join(folder, file));
  taken.push({ file, milliseconds, words });
}

// Screenshots have no mouse pointer: one that follows the mouse.
async function withPointer(page) {
  await page.evaluate(() => {
    const arrow = document.createElement("div");
    arrow.innerHTML = '<svg width="22" height="30" viewBox="0 0 22 30"><path d="M1 1v22l6-5 4 10 4-2-4-9h8z" stroke="#fff" stroke-width="1.5"/></svg>';
    arrow.style.cssText = "position: fixed; z-index: 99999; pointer-events: none; left: 500px; top: 400px";
    document.body.append(arrow);
    const follow = (event) => Object.assign(arrow.style, { left: `${event.clientX}px`, top: `${event.clientY}px` });
    for (const kind of ["mousemove", "pointermove"]) addEventListener(kind, follow, true);
  });
}

async function point(page, target) {
  const box = await target.boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2, { steps: 3 });
  await page.waitForTimeout(300);
}

async function press(page, target) {
  await point(page, target);
  await take(page, 900);
  await target.click();
}

// Pictures of the run from one text of its state to another, of which each is taken once.
async function watch(page, pattern, until, every, milliseconds) {
  let last = -Infinity;
  for (;;) {
    const state = await text(page), found = pattern.exec(state);
    if (until.test(state)) return;
    if (found && Number(found[1]) >= last + every) {
      last = Number(found[1]);
      await take(page, milliseconds);
    }
    await page.waitForTimeout(500);
  }
}

await withStudioBrowser(options, async (browser) => {
  const page = await browser.newPage();
  await page.goto(url, { timeout: 150000 });
  await page.getByText("told to the prior").waitFor();
  await page.waitForTimeout(8000);
  await withPointer(page);
  words = "Open your mesh";
  await point(page, page.locator("iframe"));
  await take(page, 1500);
  await upload(page, options.mesh, "is the base now");
  await page.waitForTimeout(6000);
  await take(page, 2500);
  words = "Move the region to where the part is to grow";
  await drag(page, ...options.drag, 6, async () => {
    await page.waitForTimeout(900);
    await take(page, 150);
  });
  await page.waitForTimeout(2500);
  await take(page, 1500);
  words = "Write what the object should look like";
  const prompt = field(page, "Prompt");
  await point(page, prompt);
  for (let letters = 5; letters < options.prompt.length; letters += 3) {
    await prompt.fill(options.prompt.slice(0, letters));
    await take(page, 130);
  }
  await prompt.fill(options.prompt);
  await prompt.press("Enter");
  await page.getByText(options.told).waitFor();
  await page.waitForTimeout(3000);
  await take(page, 2000);
  words = "Grow";
  await open(page, "Grow");
  await press(page, page.getByRole("button", { name: "Grow", exact: true }));
  await page.mouse.move(640, 700);
  words = "The part grows, then gets its material";
  await watch(page, /geometry, step (\d+)/, /appearance, step|^finished$/m, options.every, 260);
  await watch(page, /appearance, step (\d+)/, /^finished$/m, options.every, 320);
  await page.waitForTimeout(8000);
  await take(page, 2000);
  words = "Look at it from other sides";
  await open(page, "View");
  await field(page, "regions").uncheck();
  await page.waitForTimeout(2500);
  await take(page, 1500);
  await drag(page, [330, 690], [190, 705], 6, async () => {
    await page.waitForTimeout(900);
    await take(page, 220);
  });
  await drag(page, [190, 705], [420, 690], 8, async () => {
    await page.waitForTimeout(900);
    await take(page, 220);
  });
  words = "Take it with you";
  await open(page, "Grow");
  await press(page, page.getByRole("button", { name: "Download" }));
  await page.waitForTimeout(500);
  words = "The file holds the base, untouched, and the part";
  await page.waitForTimeout(4000);
  await take(page, 3500);
});
console.log(JSON.stringify(taken));
