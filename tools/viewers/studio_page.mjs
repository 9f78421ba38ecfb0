// node studio_page.mjs grow|resume|picture URL FOLDER [JSON]: drives the page of `fd_mitsuba studio` in headless Chromium.
// grow: drags the gizmo, types a prompt, grows, leaves as soon as the part is to be seen. resume: goes on, downloads.
// picture: waits, and takes a picture. Prints as JSON what it saw; pictures and downloads go into FOLDER.
import { join } from "node:path";
import { choose, download, drag, open, screenshot, text, type, upload, value, withStudioBrowser } from "./studio_driver.mjs";

const [action, url, folder, given = "{}"] = process.argv.slice(2);
const options = JSON.parse(given);
const problems = [], foreign = [], said = {};
const picture = (page, name) => screenshot(page, join(folder, `${name}.png`));

async function tab(browser) {
  const page = await browser.newPage();
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("request", (request) => /^(data|blob):/.test(request.url()) || request.url().startsWith(new URL(url).origin) || foreign.push(request.url()));
  await page.goto(url, { timeout: 150000 });
  await page.getByText("told to the prior").waitFor();
  return page;
}

async function grow(browser, page) {
  await picture(page, "opened");
  const other = options.tabs > 1 ? await tab(browser) : null;
  await page.bringToFront();
  if (options.drag) await drag(page, ...options.drag);
  await type(page, "Prompt", options.prompt);
  await page.getByText(options.told).waitFor();
  if (other) {
    await other.bringToFront(); // a tab in the background draws nothing
    await other.getByText(options.told).waitFor();
    said.prompt_of_other_tab = await value(other, "Prompt");
    await other.close();
  }
  await open(page, "Grow");
  if (options.steps) await type(page, "Steps", String(options.steps));
  await page.waitForTimeout(1500);
  const asked = Date.now();
  await page.getByRole("button", { name: "Grow", exact: true }).click();
  await page.getByText(/geometry, step/).waitFor(); // the part's first mesh comes with it
  said.first_part_seconds = (Date.now() - asked) / 1000;
  await page.waitForTimeout(options.look ?? 4000);
  said.text = await text(page);
  await picture(page, "growing");
}

async function resume(browser, page) {
  await open(page, "Grow");
  said.before = await text(page);
  await page.getByRole("button", { name: "Resume" }).click();
  if (options.learning) { // a step of the material from which on to take a picture
    // Steps come by faster than the page is drawn: a later one will do.
    await page.waitForFunction((from) => {
      const step = /appearance, step (\d+)/.exec(document.body.innerText);
      return (step && Number(step[1]) >= from) || /^finished$/m.test(document.body.innerText);
    }, options.learning, { timeout: options.patience ?? 600000 });
    await picture(page, "learning");
  }
  await page.getByText("finished", { exact: true }).waitFor({ timeout: options.patience ?? 600000 });
  await page.waitForTimeout(options.settle ?? 4000);
  await picture(page, "finished");
  said.download = await download(page, folder);
}

async function look(browser, page) {
  if (options.upload) said.notes = [await upload(page, options.upload, options.answer)];
  if (options.tab) await open(page, options.tab);
  if (options.shading) await choose(page, "Shown as", options.shading);
  if (options.light) await choose(page, "Light", options.light);
  await page.waitForTimeout(options.settle ?? 4000);
  await picture(page, "page");
  said.text = await text(page);
}

await withStudioBrowser(options, async (browser) => {
  const started = Date.now();
  const page = await tab(browser);
  said.interactive_seconds = (Date.now() - started) / 1000;
  await page.locator(".mantine-Notification-closeButton").first().click({ timeout: 5000 }).catch(() => {});
  await page.waitForTimeout(options.settle ?? 4000);
  await { grow, resume, picture: look }[action](browser, page);
});
console.log(JSON.stringify({ problems, foreign, ...said }));
