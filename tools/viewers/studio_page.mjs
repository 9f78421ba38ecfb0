// node studio_page.mjs grow|resume|picture URL FOLDER [JSON]: drives the page of `fd_mitsuba studio` in headless Chromium.
// grow: drags the gizmo, types a prompt, grows, leaves as soon as the part is to be seen. resume: goes on, downloads.
// picture: waits, and takes a picture. Prints as JSON what it saw; pictures and downloads go into FOLDER.
import { mkdtemp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [action, url, folder, given = "{}"] = process.argv.slice(2);
const options = JSON.parse(given);
const profile = await mkdtemp(join(tmpdir(), "page-"));
const quiet = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run"];
const browser = await chromium.launchPersistentContext(profile, {
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  headless: true,
  viewport: { width: options.width ?? 1280, height: options.height ?? 860 },
  acceptDownloads: true,
  timeout: 180000,
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", ...quiet],
});
browser.setDefaultTimeout(120000);
const problems = [], foreign = [], said = {};

async function tab() {
  const page = await browser.newPage();
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("request", (request) => /^(data|blob):/.test(request.url()) || request.url().startsWith(new URL(url).origin) || foreign.push(request.url()));
  await page.goto(url, { timeout: 150000 });
  await page.getByText("told to the prior").waitFor();
  return page;
}

async function picture(page, name) {
  const notice = page.locator(".mantine-Notification-root", { hasText: "Software WebGL" });
  if (await notice.isVisible()) await notice.locator(".mantine-Notification-closeButton").click();
  await page.screenshot({ path: join(folder, `${name}.png`), timeout: 240000 });
}

const row = (page, label) => page.locator("div.mantine-Flex-root", { has: page.getByText(label, { exact: true }) }).last();
const field = (page, label) => row(page, label).locator("input").first();
const value = (page, label) => field(page, label).inputValue();
const open = (page, name) => page.getByRole("tab", { name }).click();

async function type(page, label, text) {
  await field(page, label).fill(text);
  await field(page, label).press("Enter");
  await field(page, label).blur();
}

async function choose(page, label, option) {
  await field(page, label).click();
  await page.getByRole("option", { name: option, exact: true }).click();
}

async function drag(page, from, to) {
  await page.mouse.move(...from);
  await page.waitForTimeout(500);
  await page.mouse.down();
  for (let step = 1; step <= 5; step++) {
    await page.mouse.move(from[0] + ((to[0] - from[0]) * step) / 5, from[1] + ((to[1] - from[1]) * step) / 5);
    await page.waitForTimeout(300);
  }
  await page.mouse.up();
}

try {
  const started = Date.now();
  const page = await tab();
  said.interactive_seconds = (Date.now() - started) / 1000;
  await page.locator(".mantine-Notification-closeButton").first().click({ timeout: 5000 }).catch(() => {});
  await page.waitForTimeout(options.settle ?? 4000);
  if (action === "grow") {
    await picture(page, "opened");
    const other = options.tabs > 1 ? await tab() : null;
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
    said.text = await page.evaluate(() => document.body.innerText);
    await picture(page, "growing");
  } else if (action === "resume") {
    await open(page, "Grow");
    said.before = await page.evaluate(() => document.body.innerText);
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
    const waiting = page.waitForEvent("download");
    await page.getByRole("button", { name: "Download" }).click();
    const download = await waiting;
    said.download = download.suggestedFilename();
    await download.saveAs(join(folder, said.download));
  } else {
    if (options.upload) {
      const frame = page.frameLocator("iframe"); // a path, or several
      await frame.locator("input[type=file]").setInputFiles(options.upload);
      await frame.getByText(options.answer).waitFor();
      said.notes = [await frame.locator("#told").innerText()];
    }
    if (options.tab) await open(page, options.tab);
    if (options.shading) await choose(page, "Shown as", options.shading);
    if (options.light) await choose(page, "Light", options.light);
    await page.waitForTimeout(options.settle ?? 4000);
    await picture(page, "page");
    said.text = await page.evaluate(() => document.body.innerText);
  }
  console.log(JSON.stringify({ problems, foreign, ...said }));
} finally {
  await browser.close();
  await rm(profile, { recursive: true, force: true });
}
