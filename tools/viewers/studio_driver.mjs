// What a person does with the page of `fd_mitsuba studio`, in headless Chromium.
import { join } from "node:path";
import { withBrowser } from "./browser.mjs";

// Calls `drive(browser)` with a browser of the size that `options` may have.
export const withStudioBrowser = ({ width = 1280, height = 860 }, drive) =>
  withBrowser({ viewport: { width, height }, acceptDownloads: true }, (browser) => {
    browser.setDefaultTimeout(120000);
    return drive(browser);
  });

export async function screenshot(page, path) {
  const notice = page.locator(".mantine-Notification-root", { hasText: "Software WebGL" });
  if (await notice.isVisible()) await notice.locator(".mantine-Notification-closeButton").click();
  return page.screenshot({ path, timeout: 240000 });
}

export const row = (page, label) => page.locator("div.mantine-Flex-root", { has: page.getByText(label, { exact: true }) }).last();
export const field = (page, label) => row(page, label).locator("input").first();
export const value = (page, label) => field(page, label).inputValue();
export const open = (page, name) => page.getByRole("tab", { name }).click();
export const text = (page) => page.evaluate(() => document.body.innerText);

export async function type(page, label, words) {
  await field(page, label).fill(words);
  await field(page, label).press("Enter");
  await field(page, label).blur();
}

export async function choose(page, label, option) {
  await field(page, label).click();
  await page.getByRole("option", { name: option, exact: true }).click();
}

// Sends files, given by a path or several, and answers what the page says of them.
export async function upload(page, files, answer) {
  const frame = page.frameLocator("iframe");
  await frame.locator("input[type=file]").setInputFiles(files);
  await frame.getByText(answer).waitFor();
  return frame.locator("#told").innerText();
}

// Moves the mouse from one place to another with its button down; `each` is called after every step.
export async function drag(page, from, to, steps = 5, each = () => page.waitForTimeout(300)) {
  await page.mouse.move(...from);
  await page.waitForTimeout(500);
  await page.mouse.down();
  for (let step = 1; step <= steps; step++) {
    await page.mouse.move(from[0] + ((to[0] - from[0]) * step) / steps, from[1] + ((to[1] - from[1]) * step) / steps);
    await each();
  }
  await page.mouse.up();
}

// The file's name, as the page suggests it.
export async function download(page, folder) {
  const waiting = page.waitForEvent("download");
  await page.getByRole("button", { name: "Download" }).click();
  const file = await waiting;
  await file.saveAs(join(folder, file.suggestedFilename()));
  return file.suggestedFilename();
}
